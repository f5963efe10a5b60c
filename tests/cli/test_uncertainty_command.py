"""What `ddrecon uncertainty` writes and says."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from small_scene import contents, write_scene
from test_optimize_command import press_ctrl_c_in

from ddrecon.cli.commands import main
from ddrecon.io.files.folders import MANIFEST, Folder
from ddrecon.io.volumes.table import field_names, read_field
from ddrecon.uncertainty import Uncertainty

FREE = "-D optimize.parameters={density: {init: 0.2}, g: {}, lights.0.irradiance: {}}"
FAST = ["-D", "diffusion.model=none", "-D", "volume.sigma_s=5", "-D", "lights.1.radiance=0"]
KNOWN = ["-q", "-D", "optimize.noise={read: 0.05}"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a run that is finished, of density and two kinds of numbers."""
    folder = tmp_path_factory.mktemp("finished")
    scene = str(write_scene(folder))
    command = ["optimize", scene, "-o", str(folder / "run"), "-q", *FREE.split(" ", 1), *FAST]
    assert CliRunner().invoke(main, command).exit_code == 0
    return folder / "run"


@pytest.fixture
def finished(folder, made):
    """The run, in the current folder."""
    return Path(shutil.copytree(made, folder / "run"))


def volume(folder, name):
    return read_field(Path(folder, "volumes", f"{name}.npz"), name).values


def test_it_writes_deviations_numbers_and_a_page(finished, succeed):
    told = succeed("uncertainty", "run", "-o", "sure", "--calibrate", "1", "-q")
    record = json.loads(Path("sure/uncertainty.json").read_text())
    assert record["experiments"] == 1 and record["fields"]["density"]["within_1"] is None
    # More may follow: one by itself has no other to tell how often it holds.
    told = succeed("uncertainty", "run", "-o", "sure", "--resume", "-q")
    record = json.loads(Path("sure/uncertainty.json").read_text())
    field = record["fields"]["density"]
    assert record["experiments"] == 2 and 0 < field["within_1"] < field["within_2"] <= 1
    # What is written is about what was found.
    value = read_field(Path("run/volumes/density.npz"), "density").values
    np.testing.assert_allclose(volume("sure", "density_mean"), value, atol=1e-6)
    deviation = volume("sure", "density_std")
    smoke = value > 0.02 * value.max()
    size = float(np.sqrt((deviation[smoke] ** 2).mean()))
    assert deviation.min() > 0 and field["deviation"] == pytest.approx(size, rel=1e-4)
    assert list(record["numbers"]) == ["mass of density", "g", "lights.0.irradiance"]
    assert all(number["deviation"] > 0 for number in record["numbers"].values())
    # What was assumed, and how often experiments held, is said wherever deviations are.
    page = Path("sure/report.html").read_text()
    for text in (told.stdout, page):
        assert record["assumed"] in text and f"{100 * field['within_1']:.0f} % and" in text
    assert "lights.0.irradiance" in page
    succeed("export", "sure", "-o", "sure.npz")
    assert set(field_names(Path("sure.npz"))) == {"density_std", "density_mean"}


def test_no_run_is_harmed(finished, succeed, refuse):
    """Nor is a folder made where there is nothing to go on with; what was written has its names."""
    assert files_of("run") == set(Folder(finished, "run").names)
    (finished / "frames").mkdir()  # which makes no film of it
    (line,) = refuse(2, "uncertainty", "run", "-o", "sure", "--resume", *KNOWN)
    assert line.startswith("sure/checkpoints/last.pt: there is no checkpoint to resume from")
    for command in ("uncertainty run", "render scene.yaml"):
        (line,) = refuse(2, *command.split(), "-o", "run", "--overwrite", "-q")
        assert line.startswith("run: is the folder of another kind of job, run")
    light = "--light", "{type: ambient, radiance: 1}"
    succeed("render", "run", "-o", "seen", "--ring", "2", "--fluence", "--components", *light)
    succeed("uncertainty", "run", "-o", "sure", "--calibrate", "1", *KNOWN)
    for kind in ("seen", "sure"):
        assert files_of(kind) == set(Folder(Path(kind), kind).names)
    (line,) = refuse(2, "optimize", "scene.yaml", "-o", "sure", "--overwrite")
    assert line.startswith("sure: is the folder of another kind of job, uncertainty")


def files_of(folder):
    return {name for name, data in contents(Path(folder)).items() if data} - {MANIFEST}


@pytest.mark.slow
def test_one_that_stops_goes_on_to_the_same_bits(finished, run, succeed, monkeypatch):
    """Also amid an experiment, here the second."""
    succeed("uncertainty", "run", "-o", "whole", *KNOWN)
    with monkeypatch.context() as context:
        press_ctrl_c_in(context, Uncertainty, "step", 6)
        assert run("uncertainty", "run", "-o", "half", *KNOWN).exit_code == 130
    succeed("uncertainty", "run", "-o", "half", "--resume", *KNOWN)
    assert np.array_equal(volume("whole", "density_std"), volume("half", "density_std"))
    succeed("uncertainty", "run", "-o", "other", "--seed", "1", *KNOWN)
    assert not np.array_equal(volume("whole", "density_std"), volume("other", "density_std"))
