"""What `ddrecon optimize` writes, and that what it writes can be used again; stopped, resumed."""

import csv
import json
import math
import re
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from small_scene import contents

from ddrecon.errors import UsageError
from ddrecon.io.files.folders import LOCK, hold
from ddrecon.reconstruct import gradients, tuning
from ddrecon.reconstruct.objective import Comparison
from ddrecon.reconstruct.search import Search
from ddrecon.run import job, quality

OPTIMIZE = ["optimize", "scene.yaml", "-q", "-o"]
FINER = ["-D", "volume.resolution=[16, 8, 8]"]
COLUMNS = ["iteration", "seconds", "loss", "psnr", "test_psnr"]
COLUMNS += ["forward_iterations", "adjoint_iterations"]


def rows(folder):
    with Path(folder, "loss.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def column(folder, name):
    return [int(row[name]) for row in rows(folder)]


def read_json(path):
    return json.loads(Path(path).read_text())


FILES = """ddrecon.manifest scene.yaml result.yaml environment.json loss.csv parameters.json
summary.json report.html
volumes volumes/density.npz checkpoints checkpoints/last.pt checkpoints/previous.pt previews
previews/density.slices.png previews/front.png previews/side.png previews/density.slices.000002.png
previews/front.000002.png previews/side.000002.png previews/density.slices.000004.png
previews/front.000004.png previews/side.000004.png"""


def test_what_a_run_writes(succeed, density_of):
    exact = "-D", "diffusion.tolerance=1e-6", "-D", "render.steps_per_voxel=1"
    values = {"threads": 1, "seed": 7, "device": "cpu"}
    options = [word for name, value in values.items() for word in (f"--{name}", str(value))]
    options += "--preview-every", "2"
    result = succeed(*OPTIMIZE, "out", "--json", *options, *exact)
    assert set(contents(Path("out"))) == set(FILES.split())
    environment = read_json("out/environment.json")
    assert (
        values | {"torch": torch.__version__, "dtype": "float32"}
    ).items() <= environment.items()
    parameters = read_json("out/parameters.json")
    assert parameters["g"] == pytest.approx(0.3) and parameters["lights.0.irradiance"] == [3]
    assert np.shape(parameters["views.front.camera"]["matrix"]) == (4, 4)
    # The log has a row an iteration, and the summary agrees with the last.
    log, summary = rows("out"), read_json("out/summary.json")
    assert list(log[0])[: len(COLUMNS)] == COLUMNS
    assert column("out", "iteration") == [1, 2, 3, 4]
    seconds = [float(row["seconds"]) for row in log]
    assert seconds == sorted(seconds) and seconds[0] > 0
    assert float(log[-1]["loss"]) < float(log[0]["loss"])
    for row in log:
        parts = float(row["data_loss"]) + float(row["penalty"])
        assert parts == pytest.approx(float(row["loss"]), rel=1e-6) and float(row["penalty"]) >= 0
    assert int(log[-1]["forward_iterations"]) > 0 and int(log[-1]["adjoint_iterations"]) > 0
    assert json.loads(result.stdout) == summary and summary["iterations"] == 4
    for name in ("seconds", "loss"):
        assert summary[name] == pytest.approx(float(log[-1][name]), rel=1e-6)
    # Its pictures are whole ones, of light that is solved to the end.
    assert [view["split"] for view in summary["views"].values()] == ["train", "test"]
    for view, name in zip(summary["views"].values(), ("psnr", "test_psnr"), strict=True):
        assert summary[name] == view["psnr"]
        assert summary[name] == pytest.approx(float(log[-1][name]), rel=1e-4)
    # The volume is a field of the scene's, by which images are as good as the summary says.
    density = density_of("out")
    assert (density.shape, density.dtype) == ((4, 5, 6), np.float32)
    assert density.min() >= 0 and density.max() > 0
    with np.load("out/volumes/density.npz", allow_pickle=False) as archive:
        assert archive["bounds"].tolist() == [[-0.5] * 3, [0.5] * 3]
    found = "-D", "volume.density={file: out/volumes/density.npz}"
    succeed("render", "out/scene.yaml", "-o", "pictures", "-q", *found)
    rendered = read_json("pictures/render.json")["psnr"]
    environment = {name: view["psnr"] for name, view in summary["views"].items()}
    assert rendered == pytest.approx(environment, abs=1e-3)
    # The report shows every view, field and setting.
    text = Path("out/report.html").read_text()
    assert text.count("<img ") == 2 * 2 + 1 and text.count("<svg viewBox") == 2
    shown = [f"{name}: {psnr:.2f} dB" for name, psnr in environment.items()]
    shown += ["density, middle slices", "irradiance: 3.0"]
    assert all(words in text for words in [*shown, "fluxes Q1 and L1", "torch"])


def test_the_resolved_scene_runs_again_to_the_same_bits(succeed, density_of):
    succeed(*OPTIMIZE, "out", "-D", "volume.g=0.1", "--iterations", "3")
    Path("elsewhere").mkdir()
    scene = Path("out/scene.yaml").rename("elsewhere/scene.yaml")
    succeed("optimize", str(scene), "-q", "-o", "again")
    assert np.array_equal(density_of("out"), density_of("again"))
    assert scene.read_text() == Path("again/scene.yaml").read_text()


def test_overwrite_starts_afresh(succeed, density_of):
    """All that the earlier run wrote is gone, and what somebody else put beside it is not."""
    earlier = ["-D", "views.1.name=other", "-D", "optimize.parameters.sigma_s={field: true}"]
    succeed(*OPTIMIZE, "out", *earlier, "--iterations", "1", "--preview-every", "1")
    names = "notes.txt", "volumes/mine.npz", "previews/mine.png", "lights.1.radiance.npy"
    for path in (Path("out", name) for name in names):
        path.write_text(path.name)
    succeed(*OPTIMIZE, "out", "--overwrite")
    succeed(*OPTIMIZE, "fresh")
    assert np.array_equal(density_of("out"), density_of("fresh")) and len(rows("out")) == 4
    assert set(contents(Path("out"))) == {*contents(Path("fresh")), *names}
    assert all(Path("out", name).read_text() == Path(name).name for name in names)


def test_overwriting_keeps_what_the_new_run_reads(run, succeed, refuse, monkeypatch):
    """So it can be resumed, however soon it was stopped; and a scene file of the user's own."""
    succeed(*OPTIMIZE, "out", "--iterations", "1")

    def stopped(*_):
        raise KeyboardInterrupt

    again = ["optimize", "out/scene.yaml", "-q", "-o", "out", "--iterations", "1"]
    again += ["-D", "optimize.parameters.density.init={file: out/volumes/density.npz}"]
    with monkeypatch.context() as patch:
        patch.setattr("ddrecon.reconstruct.objective.render_each", stopped)
        assert run(*again, "--overwrite").exit_code == 130
    state = torch.load("out/checkpoints/last.pt", weights_only=True)["state"]
    assert state["frames"][0]["total"]["iteration"] == 0  # and not that of the run before
    assert Path("out/scene.yaml").is_file() and not Path("out/result.yaml").exists()
    succeed(*again, "--resume")
    with Path("out/scene.yaml").open("a") as stream:
        stream.write("# why 4 iterations are enough\n")
    for how in ("--overwrite", "--resume"):
        (line,) = refuse(2, "optimize", "out/scene.yaml", "-q", "-o", "out", how)
        assert line.startswith("out/scene.yaml: was changed and would be replaced")


def test_a_run_tells_on_stderr_how_far_it_is(run, monkeypatch):
    """What takes long, progress and finer cells, unless it is quiet; its time at last."""
    monkeypatch.setattr(tuning, "FEWEST_CELLS", 8)
    monkeypatch.setattr("ddrecon.progress.LONG", 0.0)
    options, start = ("-D", "volume.resolution=[16, 16, 16]"), time.monotonic()
    told = run("optimize", "scene.yaml", "-o", "one", *options)
    taken = time.monotonic() - start
    cells = column("one", "cells")
    (step,) = (i + 1 for i in range(1, 4) if cells[i] != cells[i - 1])
    stages = "reading pictures", "looking at what", "optimize:  "
    stages += f"iteration {step}: 4,096 cells", "4/4", "writing what was found", "register: "
    places = [told.stderr.index(stage) for stage in stages]
    assert places == sorted(places) and "PSNR" in told.stderr and "optimize:" not in told.stdout
    page = Path("one/report.html").read_text()
    assert page.count('class="step"') == 2 and f"finer from there ({step})" in page
    of_all, of_iterations = (
        float(re.search(words, told.stdout).group(1))
        for words in (r"(\S+) s in all", r"iterations in (\S+) s")
    )
    assert of_iterations < of_all <= taken + 0.1
    quiet = run(*OPTIMIZE, "two")
    assert quiet.stderr == "" and "4 iterations" in quiet.stdout
    monkeypatch.setattr("ddrecon.progress.LONG", 1e6)
    assert "..." not in run("optimize", "scene.yaml", "-o", "short").stderr


def test_a_report_lists_the_numbers_that_were_found(succeed):
    """As parameters.json has them, and by how much they changed; of a camera its move."""
    searched = ["lights.0.irradiance={init: 2}", "views.front.exposure={init: 0.9}"]
    searched += ["views.front.camera={}", "density={init: 0.1}", "lights.0.direction={}"]
    options = [f"optimize.parameters.{each}" for each in searched]
    succeed(*OPTIMIZE, "one", *(word for option in options for word in ("-D", option)))
    page, found = Path("one/report.html").read_text(), read_json("one/parameters.json")
    for name, start in (("lights.0.irradiance", 2), ("views.front.exposure", 0.9)):
        values = ", ".join(f"{x:.4g} ({x / start - 1:+.1%})" for x in np.ravel(found[name]))
        cells = [name, ", ".join([f"{start:.4g}"] * np.size(found[name])), values]
        assert "".join(f"<td>{cell}</td>" for cell in cells) in page
    before = np.array(yaml.safe_load(Path("one/scene.yaml").read_text())["lights"][0]["direction"])
    after = np.array(found["lights.0.direction"])
    cosine = before @ after / np.linalg.norm(before) / np.linalg.norm(after)
    (turned,) = re.findall(r"\(turned by (\S+) degrees\)", page)
    assert float(turned) == pytest.approx(np.degrees(np.arccos(cosine)), rel=0.05)
    ((moved, turned),) = re.findall(r"moved by (\S+) pixels, turned by (\S+) degrees", page)
    matrix = np.array(found["views.front.camera"]["matrix"])
    # It looked along -z: its turn is what its matrix is.
    angle = np.degrees(np.arcsin(np.linalg.norm(matrix[:3, :3] - np.eye(3)) / 8**0.5) * 2)
    assert float(moved) > 0 and float(turned) == pytest.approx(angle, rel=0.05)


def test_divergence_keeps_the_last_good_state(run, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(Comparison, "loss_of", lambda *_: torch.tensor(math.nan))
        result = run(*OPTIMIZE, "out")
    assert (result.exit_code, result.stdout) == (4, "")
    (line,) = result.stderr.splitlines()
    told = r"iteration 1: .* not finite; at most, density at voxel \[\d, \d, \d\] is \d"
    assert re.match(told, line)
    assert "; the state after 0 iterations is kept in out/checkpoints/last.pt" in line
    assert run(*OPTIMIZE, "out", "--resume").exit_code == 0


def test_a_run_that_ends_by_itself_says_why(succeed, monkeypatch):
    monkeypatch.setattr(tuning, "REST", 10.0)
    result = succeed(*OPTIMIZE, "out", "--iterations", "auto")
    summary, log = read_json("out/summary.json"), rows("out")
    ended = summary["ended"]
    assert ended["kind"] == "rest" and summary["iterations"] == len(log)
    assert ended["text"] in result.stdout.splitlines()
    assert ended["text"] in Path("out/report.html").read_text()
    assert ended["residual"] > 0 < ended["noise"]
    words = f"off by {ended['residual']:.1%}, noise and model by {ended['noise']:.1%}"
    assert words in ended["text"]
    succeed(*OPTIMIZE, "out", "--resume", "--iterations", "auto")
    assert rows("out") == log


def press_ctrl_c_in(monkeypatch, owner, name, call):
    """Ctrl-C arrives once, at the end of call number `call` of `owner.name`."""
    original, calls = getattr(owner, name), []

    def pressed(*arguments, **options):
        result = original(*arguments, **options)
        calls.append(name)
        if len(calls) == call:
            signal.raise_signal(signal.SIGINT)
        return result

    monkeypatch.setattr(owner, name, pressed)


MOMENTS = {
    "after a render at a new resolution": (gradients, "differentiate", 3),
    "after the first step": (Search, "judge", 1),
    "after a later step": (Search, "judge", 3),
}


@pytest.mark.parametrize("moment", MOMENTS)
def test_an_interrupted_run_goes_on_to_the_same_bits(run, succeed, density_of, monkeypatch, moment):
    """Its report is there, and says that it goes on; what is resumed is read under its lock."""
    monkeypatch.setattr(tuning, "FEWEST_CELLS", 4)
    monkeypatch.setattr("ddrecon.run.run_folder.PAGE_SECONDS", 0.0)
    load, call = job.load_checkpoint, MOMENTS[moment][-1]

    def load_locked(*arguments):
        with pytest.raises(UsageError, match="is writing there"), hold(Path("parts", LOCK)):
            pass
        return load(*arguments)

    monkeypatch.setattr(job, "load_checkpoint", load_locked)
    succeed(*OPTIMIZE, "whole", *FINER)
    with monkeypatch.context() as patch:
        press_ctrl_c_in(patch, *MOMENTS[moment])
        result = run(*OPTIMIZE, "parts", *FINER)
    assert (result.exit_code, result.stdout) == (130, "")
    assert len(result.stderr.splitlines()) == 1 and "interrupted" in result.stderr
    assert len(rows("parts")) in (call - 1, call)
    page = Path("parts/report.html").read_text()
    assert "It goes on." in page and 'http-equiv="refresh"' in page
    assert all(f'<section id="{name}">' in page for name in ("volume", "loss", "views"))
    succeed(*OPTIMIZE, "parts", *FINER, "--resume")
    assert column("parts", "iteration") == [1, 2, 3, 4]
    assert np.array_equal(density_of("parts"), density_of("whole"))
    done = Path("parts/report.html").read_text()
    assert "It goes on." not in done and 'http-equiv="refresh"' not in done


def test_a_run_interrupted_after_its_end_is_told_how_to_finish(run, succeed, monkeypatch):
    with monkeypatch.context() as patch:
        press_ctrl_c_in(patch, quality, "register", 1)
        result = run(*OPTIMIZE, "out")
    line = "interrupted after 4 iterations; write its results with --resume\n"
    assert (result.exit_code, result.stderr) == (130, line)
    succeed(*OPTIMIZE, "out", "--resume")
    assert Path("out/report.html").is_file()


def test_more_iterations_go_on_from_the_end(succeed, monkeypatch):
    """At the resolution that was reached, and by the folder's own scene as well."""
    monkeypatch.setattr(tuning, "FEWEST_CELLS", 4)
    command = [*OPTIMIZE, "out", *FINER, "--iterations"]
    succeed(*command, "4")
    first, reached = Path("out/loss.csv").read_text(), column("out", "cells")[-1]
    assert reached == 16 * 8 * 8
    succeed(*command, "6", "--resume")
    succeed("optimize", "out/scene.yaml", "-q", "--iterations", "7", "-o", "out", "--resume")
    assert column("out", "iteration") == [*range(1, 8)]
    assert set(column("out", "cells")[4:]) == {reached}
    assert Path("out/loss.csv").read_text().startswith(first)
