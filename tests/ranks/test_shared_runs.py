"""A run, or samples, shared by processes is that of one, and loses nothing where one is killed."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from small_scene import SCENE

from ddrecon.run.job import load_checkpoint
from ddrecon.scene_file.load import scene_text

pytestmark = pytest.mark.slow
VIEWS = {"a": (0, 0, 2.5), "b": (2.5, 0, 0), "c": (0, 0.5, -2), "d": (2, 1, 1), "e": (-2, -1, 1)}
"""Two of which are test views."""
SOUGHT = """{density: {init: 0.4, tv: 0.001}, sigma_s: {field: true}, g: {},
 lights.0.irradiance: {}, views.c.camera: {}, views.*.exposure: {}, views.*.offset: {}}"""


def write_scene(folder):
    """The small scene in five views of two sizes, of which all kinds of numbers are sought."""
    tree = yaml.safe_load(SCENE)
    tree["volume"] |= {"resolution": [8, 6, 5], "density": 0.5}
    tree["optimize"] = {"loss": "l2", "parameters": yaml.safe_load(SOUGHT)}
    camera, tree["lights"] = tree["views"][0]["camera"], tree["lights"][:1]
    tree["views"] = []
    for number, (name, origin) in enumerate(VIEWS.items()):
        width, height = (8, 6) if number % 2 else (10, 8)
        y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
        blob = np.maximum(0.4 + 0.03 * number - x**2 - (y - 0.05 * number) ** 2, 0.1)
        np.save(folder / f"{name}.npy", blob[..., None] * [1.0, 0.8, 0.6])
        view = {"name": name, "image": f"{name}.npy", "split": "test" if name in "de" else "train"}
        view["camera"] = camera | {"origin": [*origin], "resolution": [width, height]}
        tree["views"].append(view)
    (folder / "scene.yaml").write_text(scene_text(tree))


def job(ranks, output, *options, **others):
    command = ["optimize", "scene.yaml", "-o", output, "--dtype", "float64", "--engine", "torch"]
    return {"ranks": ranks, "arguments": [*command, "--iterations", "3", *options]} | others


SHOWN = ("a", "b", "d")
RENDER = ["render", "scene.yaml", "--engine", "torch", "--gradient", "density"]
RENDER += [*(word for name in SHOWN for word in ("--view", name)), "-o"]
FIELDS = "density", "sigma_s"


def sure(ranks, output, *options):
    command = ["uncertainty", "plain", "-o", output, "--engine", "torch"]
    return {"ranks": ranks, "arguments": [*command, "-D", "optimize.noise={read: 0.05}", *options]}


JOBS = {
    "one": job(1, "one"),
    "four": job(4, "four", seeds=True),
    "killed": job(2, "broken", failing=[1, 3, "killed"]),
    "resumed": job(3, "broken", "--resume"),
    "first killed": job(2, "headless", failing=[0, 2, "killed"]),
    "failed": job(2, "failed", failing=[1, 1, "is odd"]),
    "refused": job(2, "one"),
    "rendered": {"ranks": 3, "arguments": [*RENDER, "views"]},
    "alone": {"ranks": 1, "arguments": [*RENDER, "alone"]},
    "checked": {"ranks": 2, "arguments": ["check", "scene.yaml"]},
    "plain": job(1, "plain", "-D", "diffusion.model=none"),
    "sure": sure(1, "sure", "--calibrate", "2"),
    "sure begun": sure(1, "doubts", "--calibrate", "1"),
    "sure of three": sure(3, "doubts", "--calibrate", "2", "--resume"),
}


class Runs:
    """The `folder` in which `JOBS` were run, and what became of them."""

    def __init__(self, folder):
        self.folder, self.names = folder, list(JOBS)
        codes = json.loads((folder / "codes.json").read_text())
        self.codes = dict(zip(JOBS, codes, strict=True))

    def text(self, name, rank, end):
        return (self.folder / f"{self.names.index(name)}.{rank}.{end}").read_text()

    def log(self, output):
        """The log in the folder `output`, without times and steps of solves, which may be cut."""
        with (self.folder / output / "loss.csv").open() as stream:
            rows = [
                row | {"seconds": "0", "forward_iterations": "0"} for row in csv.DictReader(stream)
            ]
        return np.array([[float(cell or 0) for cell in row.values()] for row in rows])

    def found(self, output):
        """All that a run found."""
        path = self.folder / output
        numbers = json.loads((path / "parameters.json").read_text())
        fields = {name: np.load(path / f"volumes/{name}.npz")[name] for name in FIELDS}
        views = {
            name: np.ravel(value["matrix"] if isinstance(value, dict) else value)
            for name, value in numbers.items()
        }
        return fields | views

    def compare(self, output, alone):
        """Asserts that a run found what another did, to rounding, all the way."""
        np.testing.assert_allclose(self.log(output), self.log(alone), rtol=1e-7)
        expected, found = self.found(alone), self.found(output)
        assert expected.keys() == found.keys()
        assert {"views.c.exposure", "views.d.camera"} <= found.keys()
        for name, value in expected.items():
            np.testing.assert_allclose(found[name], value, rtol=1e-6, atol=1e-8, err_msg=name)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """What becomes of `JOBS`, one after the other in a folder with the scene in it."""
    folder = tmp_path_factory.mktemp("ranks")
    write_scene(folder)
    script = Path(__file__).with_name("forked.py")
    known = {name: os.environ[name] for name in ("PATH", "HOME") if name in os.environ}
    known["PYTHONPATH"] = os.pathsep.join(sys.path)
    subprocess.run(
        [sys.executable, str(script), json.dumps(list(JOBS.values())), str(folder)],
        cwd=folder,
        # The last as commands set it, before they import torch.
        env=known | {"OMP_NUM_THREADS": "1", "TORCH_CPP_LOG_LEVEL": "FATAL"},
        check=True,
    )
    return Runs(folder)


@pytest.mark.parametrize("output", ["four", "broken"])
def test_ranks_find_what_one_finds(runs, output):
    runs.compare(output, "one")


def test_the_first_rank_alone_prints(runs):
    for name in ("four", "rendered", "checked"):
        assert set(runs.codes[name]) == {0}
        assert runs.text(name, 0, "out")
        assert (runs.text(name, 1, "out"), runs.text(name, 1, "err")) == ("", "")


def test_a_killed_rank_loses_nothing(runs):
    assert runs.codes["killed"] == [5, -9]
    line = runs.text("killed", 0, "err").splitlines()[-1]
    assert line.startswith("another rank has ended (")
    assert "the state after 2 iterations is kept in broken/checkpoints/last.pt" in line
    assert runs.codes["resumed"] == [0, 0, 0]


def test_a_checkpoint_stands_where_the_first_rank_is_killed(runs):
    assert runs.codes["first killed"] == [-9, 5]
    state = load_checkpoint(runs.folder / "headless" / "checkpoints")[0]
    assert state["frames"][0]["total"]["iteration"] == 0


def test_a_rank_that_fails_says_why(runs):
    assert runs.codes["failed"] == [5, 3]
    assert runs.text("failed", 1, "err").splitlines() == ["rank 1: some.file: is odd"]
    assert "another rank has ended (" in runs.text("failed", 0, "err")
    assert runs.codes["refused"] == [2, 5]
    assert runs.text("refused", 0, "err").startswith("one: the folder is not empty")
    assert runs.text("refused", 1, "err") == ""


def test_ranks_render_what_one_renders(runs):
    files = sorted(path.name for path in (runs.folder / "alone").iterdir())
    assert files == sorted(path.name for path in (runs.folder / "views").iterdir())
    arrays = [name for name in files if name.endswith(".npy")]
    assert len(arrays) == 2 * len(SHOWN)
    for name in arrays:
        one, other = (np.load(runs.folder / output / name) for output in ("alone", "views"))
        np.testing.assert_array_equal(one, other)


def test_one_rank_imports_and_starts_nothing(runs):
    assert runs.text("one", 0, "out").splitlines()[-2:] == ["[]", "False"]


def test_ranks_make_the_experiments_of_one(runs):
    """They go on where one has begun; the first of them alone writes."""
    assert runs.codes["sure begun"] == [0]
    assert runs.codes["sure of three"] == [0, 0, 0]
    assert runs.text("sure of three", 0, "out") and not runs.text("sure of three", 1, "out")
    one, other = (sorted((runs.folder / output).rglob("*.npz")) for output in ("sure", "doubts"))
    assert [path.name for path in one] == [path.name for path in other]
    for known, found in zip(one, other, strict=True):
        for key, value in np.load(known).items():
            np.testing.assert_allclose(np.load(found)[key], value, rtol=1e-5, atol=1e-7)
