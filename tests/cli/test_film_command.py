"""A film from the command line: each frame is a run, and nothing depends on when it was done."""

import json
import os
import re
import shutil
import subprocess
import sys
from contextlib import chdir
from itertools import chain, product
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import openvdb_python
import pytest
import torch
from click.testing import CliRunner
from small_scene import contents

import ddrecon
from ddrecon import load_scene, render
from ddrecon.cli.commands import main
from ddrecon.errors import UsageError
from ddrecon.film import MIXED, share_out, spread_out
from ddrecon.io.files.folders import LOCK, MANIFEST, Folder, hold
from ddrecon.io.volumes.table import read_field, write_field
from ddrecon.numerics.flow import find_flow
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.run.run_folder import load_run
from ddrecon.scene_file.build import build_scene
from ddrecon.scene_file.build_views import at_frame
from ddrecon.scene_file.load import describe, dump_scene, read_scene

FRAMES = 4
VIEWS = {"front": [0, 0, 2.5], "left": [-2.2, 0.2, 1.0], "side": [2.5, 0, 0]}
SCENE = """\
frames: {first: 0, last: 3, calibrate: 2}
volume: {bounds: {min: [-0.5, -0.5, -0.5], max: [0.5, 0.5, 0.5]}, resolution: [8, 8, 8],
  density: 0, sigma_t: 8, albedo: 0.9}
lights:
  - {type: directional, direction: [-1, -2, -1], irradiance: 2.5}
views:
"""
REST = """\
diffusion: {model: none}
optimize:
  iterations: 16
  parameters: {density: {init: 0}, lights.0.irradiance: {}, "views.*.exposure": {}}
"""
SCATTERED = "diffusion={transport_rounds: 0}"
"""How the pictures are made; what says nothing of what is found does without."""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with film.yaml and the pictures of a ball that moves."""
    folder = tmp_path_factory.mktemp("film")
    lines = [
        f"  - {{name: {name}, image: '{name}_{{frame:02d}}.npy', camera: {{type: perspective, "
        f"fov: 30, origin: {place}, target: [0, 0, 0], resolution: [12, 12]}}"
        + (", split: test}" if name == "side" else "}")
        for name, place in VIEWS.items()
    ]
    (folder / "film.yaml").write_text(SCENE + "\n".join(lines) + "\n" + REST)
    z, y, x = np.mgrid[-0.44:0.44:8j, -0.44:0.44:8j, -0.44:0.44:8j]
    for name in VIEWS:
        np.save(folder / f"{name}_00.npy", np.ones((12, 12, 3), np.float32))
    overrides = [f"volume.density={{file: {folder}/ball.npz}}", "lights.0.irradiance=3"]
    overrides.append(SCATTERED)
    for number in reversed(range(FRAMES)):
        ball = np.exp(-(z**2 + (y + 0.1 - 0.05 * number) ** 2 + x**2) / 0.05)
        write_field(folder / "ball.npz", "density", ball, np.array([[-0.5] * 3, [0.5] * 3]))
        scene = load_scene(folder / "film.yaml", overrides=overrides)
        for view, picture in zip(scene.views, render(scene), strict=True):
            np.save(folder / f"{view.name}_{number:02d}.npy", picture.permute(1, 2, 0).numpy())
    return folder


@pytest.fixture
def film(made, folder):
    """The current folder, with what is in the one that was made."""
    return Path(shutil.copytree(made, folder, dirs_exist_ok=True))


@pytest.fixture(scope="module")
def whole(made, tmp_path_factory):
    """The folder of the film's run, left alone from beginning to end; the film is beside it."""
    folder = Path(shutil.copytree(made, tmp_path_factory.mktemp("whole"), dirs_exist_ok=True))
    with chdir(folder):
        assert CliRunner().invoke(main, optimize("-o", "whole")).exit_code == 0
    return str(folder / "whole")


FEW = "-D", "optimize.iterations=3"
ALONE = *FEW, "-D", "frames.calibrate=0"


def volumes(folder):
    """The arrays of all volumes in the folder of a film, by file."""
    return {
        str(path.relative_to(folder)): b"".join(
            np.load(path)[name].tobytes() for name in sorted(np.load(path).files)
        )
        for path in sorted(Path(folder).rglob("*.npz"))
    }


def optimize(*arguments):
    return ("optimize", "film.yaml", *arguments, "-q", "--dtype", "float64")


def test_a_film_is_runs_in_a_sequence(whole, film, succeed):
    out = Path(whole)
    record = json.loads((out / "film.json").read_text())
    assert [row["frame"] for row in record["frames"]] == list(range(FRAMES))
    assert all(1 <= row["iterations"] <= 16 for row in record["frames"])
    assert all(row["registered_psnr"] >= row["test_psnr"] for row in record["frames"])
    # Its page has the volume of each frame beside its pictures.
    page = (out / "report.html").read_text()
    data = re.findall(r'<script type="application/json" class="field">(.*?)</script>', page)
    fields = [json.loads(text) for text in data]
    assert [(field["name"], field["frame"]) for field in fields] == [
        ("density", n) for n in range(FRAMES)
    ]
    assert len({field["data"] for field in fields}) == 4 and len({f["white"] for f in fields}) == 1
    assert 'data-frames="[0, 1, 2, 3]"' in page and '"name": "side"' in page
    # What is shared is the same in all frames, and known for what it is.
    shared = json.loads((out / "shared.json").read_text())
    assert shared["frames"] == [0, 3] and not (out / "checkpoints").exists()
    for number in range(FRAMES):
        parameters = json.loads((out / f"frames/{number:04d}/parameters.json").read_text())
        assert parameters["lights.0.irradiance"] == [shared["values"]["lights.0.irradiance"]]
    # The ball rises by 0.05 u a frame: so says its velocity, where there is something.
    velocity, density = (
        read_field(out / f"frames/0003/volumes/{name}.npz", name).values
        for name in ("velocity", "density")
    )
    mean = (velocity * density[..., None]).sum((0, 1, 2)) / density.sum()
    assert 0.03 < mean[1] < 0.07 and abs(mean[0]) < 0.02 and abs(mean[2]) < 0.02
    # Each is a run as any other, and some are rendered together.
    succeed("render", whole, "-o", "seen", "--frames", "1:2", "--view", "side")
    succeed("render", f"{whole}/frames/0002", "-o", "one", "--view", "side")
    assert {path.name for path in Path("seen").iterdir()} == {"0001", "0002", MANIFEST}
    np.testing.assert_array_equal(np.load("seen/0002/side.npy"), np.load("one/side.npy"))
    load_run(out / "frames/0002", lambda dtype: load_scene(out / "frames/0002/scene.yaml"))
    # Its calibration goes to another film.
    succeed(*optimize("-o", "other", "--shared", f"{whole}/shared.json", "--frames", "2:", *FEW))
    assert not Path("other/calibration").exists()
    assert sorted(path.name for path in Path("other/frames").iterdir()) == ["0002", "0003"]


def test_a_still_film_without_calibration_is_the_single_run(film, succeed):
    for name in VIEWS:
        np.save(f"{name}_01.npy", np.load(f"{name}_00.npy"))
    succeed(*optimize("-o", "out", "--frames", "0:1", *ALONE))
    text = Path("film.yaml").read_text().replace("{frame:02d}", "00")
    Path("single.yaml").write_text(re.sub("frames: .*\n", "", text))
    succeed("optimize", "single.yaml", "-o", "single", "-q", "--dtype", "float64", *FEW)
    first, start = volumes("out/frames/0000"), volumes("out/frames/0001")
    density = first["volumes/density.npz"]
    assert volumes("single")["volumes/density.npz"] == density
    assert start["start/volumes/density.npz"] == density


@pytest.mark.slow
def test_a_frame_keeps_a_part_of_its_start(whole, succeed):
    frame = Path(whole) / "frames/0002"
    given = "-q", "--dtype", "float64", "-D", "optimize.keep_start=0"
    succeed("optimize", str(frame / "scene.yaml"), "-o", "bare", *given)
    bare, start, kept = (
        read_field(place / "volumes/density.npz", "density").values
        for place in (Path("bare"), frame / "start", frame)
    )
    assert np.abs(bare - start).max() > 1e-3
    np.testing.assert_allclose(kept, (1 - MIXED) * bare + MIXED * start, atol=1e-6)


@pytest.mark.slow
def test_a_part_far_from_others_knows_nothing_of_them(film, succeed):
    """It begins from nothing, and its first frame moves as the second does."""
    for name in VIEWS:
        for number in range(4, 10):
            source = number - 6 if number > 7 else 0
            np.save(f"{name}_{number:02d}.npy", np.load(f"{name}_{source:02d}.npy"))
    sizes = *ALONE, "-D", "frames.last=9"
    for folder, part in (("alone", "8:9"), ("out", "0:1"), ("out", "8:9")):
        succeed(*optimize("-o", folder, "--resume", "--frames", part, *sizes))
    out, alone = volumes("out"), volumes("alone")
    assert alone.items() <= out.items()
    assert not [file for file in out if file.startswith("frames/0008/start")]
    arrows = [out[f"frames/000{number}/volumes/velocity.npz"] for number in (8, 9)]
    assert arrows[0] == arrows[1]


@pytest.fixture
def killed_at(monkeypatch):
    """Has the process die in its `n`-th iteration of all; checkpoints are written at each."""
    monkeypatch.setattr("ddrecon.run.job.CHECKPOINT_SECONDS", 0)
    monkeypatch.setattr("ddrecon.run.job.CHECKPOINT_SHARE", 1e9)
    advance, count = Reconstruction.advance, iter(range(10**6))

    def arm(last):
        nonlocal count
        count = iter(range(last))

    def counted(run):
        if next(count, None) is None:
            raise SystemExit(9)
        return advance(run)

    monkeypatch.setattr(Reconstruction, "advance", counted)
    return arm


@pytest.mark.slow
def test_killed_anywhere_and_in_parts_to_the_same_bits(whole, film, succeed, run, killed_at):
    """In the calibration, amid a frame, and again."""
    first = optimize("-o", "parts", "--resume", "--frames", "0:1")
    for last in (3, 14, 5, 3):
        killed_at(last)
        assert run(*first).exit_code == 9
    killed_at(10**6)
    succeed(*first)
    for part in ("2:2", "3:"):
        succeed(*optimize("-o", "parts", "--resume", "--frames", part))
    assert volumes("parts") == volumes(whole)
    shared = [json.loads(Path(place, "shared.json").read_text()) for place in ("parts", whole)]
    assert shared[0] == shared[1]
    films = [json.loads(Path(place, "film.json").read_text()) for place in ("parts", whole)]
    psnrs = [[row["psnr"] for row in record["frames"]] for record in films]
    assert psnrs[0] == psnrs[1]


@pytest.mark.slow
def test_ranks_share_out_the_frames_and_calibrate_once(film):
    """The second waits, and takes what the first has found; the last to end knows of all."""
    job = {"ranks": 2, "arguments": optimize("-o", "out", "-D", "frames.last=1", *FEW)}
    script = Path(__file__).parents[1] / "ranks/forked.py"
    known = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    run = [sys.executable, str(script), json.dumps([job]), "."]
    subprocess.run(run, check=True, timeout=200, env=known)
    assert json.loads(Path("codes.json").read_text()) == [[0, 0]]
    frames = json.loads(Path("out/film.json").read_text())["frames"]
    assert [row["frame"] for row in frames] == [0, 1]
    found = [json.loads(Path(f"out/frames/000{n}/parameters.json").read_text()) for n in (0, 1)]
    assert found[0]["lights.0.irradiance"] == found[1]["lights.0.irradiance"]


def test_ranks_share_out_all_frames(monkeypatch):
    for frames, count in product(range(1, 6), range(1, 8)):
        monkeypatch.setattr("ddrecon.film.rank_count", lambda count=count: count)
        shares = []
        for rank in range(count):
            monkeypatch.setattr("ddrecon.film.own_rank", lambda rank=rank: rank)
            shares.append(share_out(range(frames)))
        assert [*chain(*shares)] == [*range(frames)] and shares[0]
        assert max(map(len, shares)) == -(-frames // count)


def test_frames_of_films_are_those_of_pictures(film, refuse):
    """Each camera by its own count; a scene says which frame is its, and is read again as such."""
    pytest.importorskip("imageio_ffmpeg", reason="films are an extra")
    text = Path("film.yaml").read_text()
    for ahead, name in enumerate(VIEWS):
        noise = np.random.default_rng(ahead).integers(0, 255, (FRAMES + ahead, 12, 12, 3), np.uint8)
        for number in range(FRAMES):
            iio.imwrite(f"{name}_{number:02d}.png", noise[number + ahead])
        exact = {"codec": "libx264rgb", "output_params": ["-crf", "0"], "macro_block_size": 1}
        iio.imwrite(f"{name}.mp4", noise, pixelformat="rgb24", quality=None, **exact)
        begin = f"time: {ahead / 10}" if ahead % 2 else f"frame: {ahead}"
        text = text.replace(f"'{name}_{{frame:02d}}.npy'", f"{name}.mp4, {begin}")
    Path("mp4.yaml").write_text(text)
    Path("png.yaml").write_text(Path("film.yaml").read_text().replace(".npy", ".png"))
    for number in range(FRAMES):
        one, other = (at_frame(read_scene(name), number) for name in ("mp4.yaml", "png.yaml"))
        dump_scene(describe(one), Path("again.yaml"))
        for scene in (build_scene(one), load_scene("again.yaml")):
            for view, picture in zip(scene.views, build_scene(other).views, strict=True):
                assert torch.equal(view.image, picture.image) and view.step == picture.step
    (line, *_) = refuse(3, "optimize", "mp4.yaml", "-o", "out", "-D", "frames.last=4")
    assert "front.mp4: has no frame 4, counted from 0: it has" in line
    Path("front.mp4").write_bytes(Path("front.mp4").read_bytes()[:-600])
    (line,) = refuse(3, "check", "mp4.yaml")
    assert line.endswith("front.mp4: is damaged, or no film")


@pytest.mark.slow
def test_from_python(whole, film):
    sizes = ["frames.last=1", "frames.calibrate=0", "optimize.iterations=3"]
    found = list(ddrecon.optimize_sequence("film.yaml", overrides=sizes, dtype=torch.float64))
    assert all(1 <= len(result.rows) <= 3 for result in found)
    kept = list(ddrecon.optimize_sequence(Path(whole).with_name("film.yaml"), whole))
    for number, result in enumerate(kept):
        there = read_field(Path(f"{whole}/frames/{number:04d}/volumes/density.npz"), "density")
        np.testing.assert_array_equal(result.scene.volume.density, there.values)
    assert len(kept) == FRAMES
    with pytest.raises(ddrecon.SceneError, match="frames: missing section"):
        next(ddrecon.optimize_sequence("scene.yaml"))


@pytest.mark.slow
def test_a_frame_that_fails_is_named_and_left_to_a_resume(film, run):
    Path("front_01.npy").write_bytes(b"broken")
    few = optimize("-o", "out", "-D", "frames.last=2", *FEW)
    first = run(*few)
    assert first.exit_code == 3
    warned, told = first.stderr.splitlines()
    assert warned.startswith(f"warning: frame 1, left out: {film}/front_01.npy: ")
    assert told.startswith(f"{film}/front_01.npy: ")
    assert len(json.loads(Path("out/film.json").read_text())["frames"]) == 2
    # Arrows of the last are those of one of its two frames.
    fields = (read_field(Path(f"out/frames/000{n}/volumes/density.npz"), "density") for n in (0, 2))
    flow = find_flow(*(torch.from_numpy(field.values) for field in fields)) / 2 / 8
    arrows = read_field(Path("out/frames/0002/volumes/velocity.npz"), "velocity").values
    np.testing.assert_allclose(arrows, flow.flip(0).permute(1, 2, 3, 0), rtol=1e-4, atol=1e-6)
    page, refresh = Path("out/report.html"), 'http-equiv="refresh"'
    assert refresh in page.read_text()
    np.save("front_01.npy", np.load("front_00.npy"))
    assert run(*few, "--resume").exit_code == 0
    assert refresh not in page.read_text()


MISUSE = """
-D frames.last=-1 => -D frames.last=-1: frames.last: must be at least 0
-D frames.first=9 => film.yaml:1:26: frames.last: 3 comes before
-D frames.last=4 => front_04.npy
--frames 7:9 => --frames 7:9: names no frame
--frames 1-2 => --frames 1-2: names no frame
--shared no.json => --shared no.json: there is no such file
--shared scene.yaml => scene.yaml: not JSON
--shared strange.json => shared.json: views.top.exposure: the scene has none
-D frames= => frames: {first: 0, last: 99}
-D optimize= => none changes from frame to frame
-D optimize.parameters={lights.0.irradiance:{}} => none changes from frame to frame
"""


@pytest.mark.parametrize("row", MISUSE.strip().splitlines())
def test_misuse_is_one_line(film, run, row):
    arguments, _, words = row.partition(" => ")
    Path("strange.json").write_text('{"values": {"views.top.exposure": 1.0}}')
    result = run(*optimize("-o", "out", *arguments.replace("e:{", "e: {").split(" ", 1)))
    assert result.exit_code == (3 if "scene.yaml" in arguments else 2)
    assert words in result.stderr.splitlines()[0]


def test_misuse_of_folders(whole, film, succeed, refuse):
    """Parts of a film are those of films, of the same film, and of its frames."""
    shutil.copytree(whole, "whole")
    assert "not empty" in refuse(2, *optimize("-o", "whole"))[0]
    other = refuse(2, *optimize("-o", "whole", "--resume", "-D", "volume.albedo=0.5"))[0]
    assert "another output folder: volume.albedo is 0.9 there, 0.5 now" in other
    for command, line in (("optimize", "is for films"), ("render", "is for the folders of films")):
        lines = refuse(2, command, "scene.yaml", "-o", "single", "--frames", "0:1")
        assert f"--frames {line}" in lines[-1]
    assert "names no frame" in refuse(2, "render", "whole", "-o", "seen", "--frames", "7:9")[0]
    lines = refuse(2, "optimize", "scene.yaml", "-o", "whole", "--overwrite")[0]
    assert lines.startswith("whole: is the folder of another kind of job, film")
    (advice,) = re.findall("`ddrecon (.*)`", refuse(2, "export", "whole", "-o", "out.vdb")[0])
    succeed(*advice.split(), "-q", "--dtype", "float64", "--frames", "0:0")
    assert Path("whole/sequence/film_0000.vdb").is_file()


def test_a_sequence_is_turned_and_moves_by_the_second(film, whole, succeed):
    """Arrows turn as places do, and go as far in a second as in all of its frames."""
    shutil.copytree(whole, "whole")
    again = "optimize", f"{whole}/scene.yaml", "-o", "whole", "--resume", "--dtype", "float64"
    succeed(*again, "-q", "--export", "vdb", "--up", "z", "-D", "frames.fps=25")
    names = sorted(path.name for path in Path("whole/sequence").iterdir())
    assert names == [f"film_{number:04d}.vdb" for number in range(FRAMES)]
    exported = Path("whole/sequence/film_0002.vdb")
    by_frame, turned = (
        read_field(path, "velocity").values.astype(float)
        for path in (Path("whole/frames/0002/volumes/velocity.npz"), exported)
    )
    moved = np.where(np.abs(by_frame).max(-1, keepdims=True) > 1e-4 * np.abs(by_frame).max(), 25, 0)
    x, y, z = (moved * by_frame).transpose(3, 0, 1, 2)
    there = np.stack([x, -z, y], -1).transpose(1, 0, 2, 3)[:, ::-1]
    np.testing.assert_allclose(turned, there, rtol=1e-5, atol=1e-7)
    facts = "[grids['velocity'][name] for name in ('fps', 'units')]"
    fps, units = openvdb_python.described(facts, exported)
    assert fps == 25 and "velocity [u/s]" in units


@pytest.mark.slow
def test_a_part_done_anew_leaves_all_else(film, run, succeed, refuse, monkeypatch):
    """And nothing is touched while another process is there, or where it is another film."""
    succeed(*optimize("-o", "out", "--frames", "0:1", "--export", "npz", *ALONE))
    before, places = contents(film / "out"), ("frames/0000", "frames/0001")
    written = {
        f"{place}/{name}".removeprefix("./")
        for place in (".", *places)
        for name in (MANIFEST, *Folder(Path("out", place), "run").names)
    }
    assert {name for name, data in before.items() if data is not None} <= written
    for place in places:
        Path("out", place, "mine.txt").write_text("mine")
    redo = optimize("-o", "out", "--frames", "1:1", "--overwrite", *ALONE)
    advance = Reconstruction.advance

    def advance_locked(run):
        with pytest.raises(UsageError, match="is writing there"), hold(Path("out", LOCK)):
            pass
        return advance(run)

    with monkeypatch.context() as patch:
        patch.setattr(Reconstruction, "advance", advance_locked)
        succeed(*redo, "--export", "npz")
    after = contents(film / "out")
    first = [name for name in before if name.startswith("frames/0000")]
    assert {name: before[name] for name in first} == {name: after[name] for name in first}
    assert after.keys() == before.keys() | {f"{place}/mine.txt" for place in places}
    assert after["frames/0001/loss.csv"] != before["frames/0001/loss.csv"]
    (line,) = refuse(2, *redo, "-D", "volume.albedo=0.5")
    assert line.startswith("out: holds another film; use another output folder: volume.albedo")
    for place in ("out", "out/frames/0001"):
        with hold(Path(place, LOCK)):
            for how in (redo, optimize("-o", "out", "--overwrite", *ALONE)):
                (line,) = refuse(2, *how)
                assert line.startswith(f"{place}: process ") and "is writing there" in line
    loud = [word for word in optimize("-o", "out", "--resume", "--frames", "1:1") if word != "-q"]
    assert (
        "stay as they are: 1 (--frames 1:1 --overwrite "
        in run(*loud, "-D", "frames.calibrate=0").stderr
    )
    assert not [*Path("out").rglob("checkpoints/previous.pt")]


def test_frames_are_spread_over_all():
    for count in range(2, 9):
        found = spread_out(range(3, 40, 2), count)
        assert len(set(found)) == count and (found[0], found[-1]) == (3, 39)
        gaps = np.diff(found)
        assert gaps.max() - gaps.min() <= 2
    assert spread_out([5, 6], 3) == [5, 6]
