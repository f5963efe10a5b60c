"""What `ddrecon optimize` writes, and that what it writes can be used again."""

import csv
import json
import math
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from click.testing import Result
from small_scene import contents

from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.objective import Comparison

Run = Callable[..., Result]
Refuse = Callable[..., list[str]]
DensityOf = Callable[[str], np.ndarray]
OPTIMIZE = ["optimize", "scene.yaml", "-q", "-o"]
COLUMNS = ["iteration", "seconds", "loss", "psnr", "test_psnr"]
COLUMNS += ["forward_iterations", "adjoint_iterations"]


def rows(folder: str) -> list[dict[str, str]]:
    with Path(folder, "loss.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def read_json(path: str) -> Any:
    return json.loads(Path(path).read_text())


FILES = """ddrecon.manifest scene.yaml result.yaml environment.json loss.csv parameters.json
summary.json report.html
volumes volumes/density.npz checkpoints checkpoints/last.pt checkpoints/previous.pt previews
previews/density.slices.png previews/front.png previews/side.png"""


def test_what_a_run_writes(succeed: Run, density_of: DensityOf) -> None:
    exact = "-D", "diffusion.tolerance=1e-6", "-D", "render.steps_per_voxel=1"
    result = succeed(*OPTIMIZE, "out", "--json", *exact)
    assert set(contents(Path("out"))) == set(FILES.split())
    parameters = read_json("out/parameters.json")
    assert parameters["g"] == pytest.approx(0.3) and parameters["lights.0.irradiance"] == [3]
    assert np.shape(parameters["views.front.camera"]["matrix"]) == (4, 4)
    # The log has a row an iteration, and the summary agrees with the last.
    log, summary = rows("out"), read_json("out/summary.json")
    assert list(log[0])[: len(COLUMNS)] == COLUMNS
    assert [int(row["iteration"]) for row in log] == [1, 2, 3, 4]
    seconds = [float(row["seconds"]) for row in log]
    assert seconds == sorted(seconds) and seconds[0] > 0
    assert float(log[-1]["loss"]) < float(log[0]["loss"])
    for row in log:
        parts = float(row["data_loss"]) + float(row["penalty"])
        assert parts == pytest.approx(float(row["loss"]), rel=1e-6) and float(row["penalty"]) >= 0
    assert int(log[-1]["forward_iterations"]) > 0 and int(log[-1]["adjoint_iterations"]) > 0
    assert json.loads(result.stdout) == summary and summary["iterations"] == 4
    for name in ("seconds", "loss", "psnr", "test_psnr"):
        assert summary[name] == pytest.approx(float(log[-1][name]), rel=1e-6)
    assert [view["split"] for view in summary["views"].values()] == ["train", "test"]
    # The volume is a field of the scene's, by which images are as good as the summary says.
    density = density_of("out")
    assert (density.shape, density.dtype) == ((4, 5, 6), np.float32)
    assert density.min() >= 0 and density.max() > 0
    with np.load("out/volumes/density.npz", allow_pickle=False) as archive:
        assert archive["bounds"].tolist() == [[-0.5] * 3, [0.5] * 3]
    found = "-D", "volume.density={file: out/volumes/density.npz}"
    succeed("render", "out/scene.yaml", "-o", "pictures", "-q", *found)
    rendered = read_json("pictures/render.json")["psnr"]
    told = {name: view["psnr"] for name, view in summary["views"].items()}
    assert rendered == pytest.approx(told, abs=1e-3)
    # The report shows every view, field and setting.
    text = Path("out/report.html").read_text()
    assert text.count("<img ") == 2 * 2 + 1 and text.count("<svg viewBox") == 2
    shown = [f"{name}: {psnr:.2f} dB" for name, psnr in told.items()]
    shown += ["density, middle slices", "irradiance: 3.0"]
    assert all(words in text for words in [*shown, "fluxes Q1 and L1", "torch"])


def test_the_resolved_scene_runs_again_to_the_same_bits(
    succeed: Run, density_of: DensityOf
) -> None:
    succeed(*OPTIMIZE, "out", "-D", "volume.g=0.1", "--iterations", "3")
    Path("elsewhere").mkdir()
    scene = Path("out/scene.yaml").rename("elsewhere/scene.yaml")
    succeed("optimize", str(scene), "-q", "-o", "again")
    assert np.array_equal(density_of("out"), density_of("again"))
    assert scene.read_text() == Path("again/scene.yaml").read_text()


def test_the_environment(succeed: Run) -> None:
    given = {"threads": 1, "seed": 7, "dtype": "float64", "device": "cpu"}
    options = [word for name, value in given.items() for word in (f"--{name}", str(value))]
    succeed(*OPTIMIZE, "out", *options, "--iterations", "1")
    told = read_json("out/environment.json")
    assert (given | {"torch": torch.__version__}).items() <= told.items()
    assert torch.get_num_threads() == 1


def test_previews_along_the_way(succeed: Run) -> None:
    succeed(*OPTIMIZE, "out", "--preview-every", "2")
    names, marks = ("density.slices", "front", "side"), ("", ".000002", ".000004")
    found = {path.stem for path in Path("out/previews").iterdir()}
    assert found == {f"{name}{mark}" for name in names for mark in marks}


def test_overwrite_starts_afresh(succeed: Run, density_of: DensityOf) -> None:
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


def test_overwriting_keeps_what_the_new_run_reads(
    run: Run, succeed: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So it can be resumed, however soon it was stopped."""
    succeed(*OPTIMIZE, "out")

    def stopped(*_: object) -> None:
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


def test_a_scene_file_of_the_users_own_stays(succeed: Run, refuse: Refuse) -> None:
    """Even where it was a run's once."""
    succeed(*OPTIMIZE, "out", "--iterations", "1")
    with Path("out/scene.yaml").open("a") as stream:
        stream.write("# why 4 iterations are enough\n")
    for how in ("--overwrite", "--resume"):
        (line,) = refuse(2, "optimize", "out/scene.yaml", "-q", "-o", "out", how)
        assert line.startswith("out/scene.yaml: was changed and would be replaced")


def test_progress_is_on_stderr_and_silenced_by_q(run: Run) -> None:
    loud, quiet = run("optimize", "scene.yaml", "-o", "one"), run(*OPTIMIZE, "two")
    assert "4/4" in loud.stderr and "PSNR" in loud.stderr and quiet.stderr == ""
    assert "register: " in loud.stderr
    assert "optimize:" not in loud.stdout and "4 iterations" in quiet.stdout


def test_where_cells_get_finer_and_all_the_time_that_a_run_took_are_told(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its lines and the curves of its report: held-out views seem to get worse there."""
    monkeypatch.setattr(tuning, "FEWEST_CELLS", 8)
    options = "-D", "volume.resolution=[16, 16, 16]"
    start = time.monotonic()
    told = run("optimize", "scene.yaml", "-o", "one", *options)
    taken = time.monotonic() - start
    cells = [row["cells"] for row in rows("one")]
    (step,) = (i + 1 for i in range(1, 4) if cells[i] != cells[i - 1])
    assert (
        f"iteration {step}: 4,096 cells from here; PSNRs are of pictures as coarse" in told.stderr
    )
    page = Path("one/report.html").read_text()
    assert page.count('class="step"') == 2 and f"finer from there ({step})" in page
    of_all, of_iterations = (
        float(re.search(words, told.stdout).group(1))
        for words in (r"(\S+) s in all", r"iterations in (\S+) s")
    )
    assert of_iterations < of_all <= taken + 0.1


def test_what_takes_long_before_and_after_the_bar_is_told(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ddrecon.progress.LONG", 1e6)
    assert "..." not in run("optimize", "scene.yaml", "-o", "short").stderr
    monkeypatch.setattr("ddrecon.progress.LONG", 0.0)
    told = run("optimize", "scene.yaml", "-o", "long").stderr
    stages = ("reading pictures", "looking at what", "optimize:", "writing what was found")
    places = [told.index(stage) for stage in stages]
    assert places == sorted(places) and run(*OPTIMIZE, "quiet").stderr == ""


def test_a_report_lists_the_numbers_that_were_found(succeed: Run) -> None:
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


def test_divergence_keeps_the_last_good_state(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(Comparison, "loss_of", lambda *_: torch.tensor(math.nan))
        result = run(*OPTIMIZE, "out")
    assert (result.exit_code, result.stdout) == (4, "")
    (line,) = result.stderr.splitlines()
    told = r"iteration 1: .* not finite; at most, density at voxel \[\d, \d, \d\] is \d"
    assert re.match(told, line)
    assert "; the state after 0 iterations is kept in out/checkpoints/last.pt" in line
    assert run(*OPTIMIZE, "out", "--resume").exit_code == 0


def test_a_run_that_ends_by_itself_says_why(succeed: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tuning, "REST", 10.0)
    result = succeed(*OPTIMIZE, "out", "--iterations", "auto")
    summary, log = read_json("out/summary.json"), rows("out")
    ended = summary["ended"]
    assert ended["kind"] == "rest" and summary["iterations"] == len(log)
    assert ended["text"] in result.stdout.splitlines()
    assert ended["text"] in Path("out/report.html").read_text()
    assert ended["residual"] > 0 < ended["noise"]
    assert (
        f"off by {ended['residual']:.1%}, noise and model by {ended['noise']:.1%}" in ended["text"]
    )
    succeed(*OPTIMIZE, "out", "--resume", "--iterations", "auto")
    assert rows("out") == log
