"""Commands run by several processes, of a small scene, and what became of them."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

Job = dict[str, Any]
"""As `forked.py` takes them."""
SCENE = """\
volume:
  bounds: {min: [-0.5, -0.5, -0.5], max: [0.5, 0.5, 0.5]}
  resolution: [8, 6, 5]
  density: 0.5
  sigma_a: 0.5
  sigma_s: [6, 5, 4]
  g: 0.3
lights:
  - {type: directional, direction: [-1, -2, -1], irradiance: 3}
diffusion: {transport_rounds: 0}
optimize:
  views_per_iteration: 2
  loss: l2
  parameters:
    density: {init: 0.4, tv: 1e-3}
    sigma_s: {field: true}
    g: {}
    lights.0.irradiance: {}
    views.a.camera: {}
    views.c.camera: {}
    views.*.exposure: {}
    views.*.offset: {}
views:
"""
VIEWS = {"a": (0, 0, 2.5), "b": (2.5, 0, 0), "c": (0, 0.5, -2)}
TESTS = {"d": (2, 1, 1), "e": (-2, -1, 1)}


def write_scene(folder: Path) -> None:
    """A scene of five training views of two sizes, and two test views."""
    text = SCENE
    for number, (name, origin) in enumerate((VIEWS | TESTS).items()):
        width, height = (8, 6) if number % 2 else (10, 8)
        y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
        blob = np.maximum(0.4 + 0.03 * number - x**2 - (y - 0.05 * number) ** 2, 0.1)
        np.save(folder / f"{name}.npy", blob[..., None] * [1.0, 0.8, 0.6])
        camera = f"origin: {list(origin)}, target: [0, 0, 0], resolution: [{width}, {height}]"
        split = "test" if name in TESTS else "train"
        text += f"  - {{name: {name}, image: {name}.npy, split: {split},\n"
        text += f"     camera: {{type: perspective, fov: 30, {camera}}}}}\n"
    (folder / "scene.yaml").write_text(text)


def job(ranks: int, output: str, *options: str, **others: Any) -> Job:
    command = ["optimize", "scene.yaml", "-o", output, "--dtype", "float64", "--engine", "torch"]
    return {"ranks": ranks, "arguments": [*command, "--iterations", "4", *options]} | others


RENDER = ["render", "scene.yaml", "--engine", "torch", "--gradient", "density", "-o"]
FIELDS = "density", "sigma_s"


class Runs:
    """The `folder` in which `jobs` were run, by name, and what became of them."""

    def __init__(self, folder: Path, jobs: Mapping[str, Job]):
        self.folder, self.names = folder, list(jobs)
        codes = json.loads((folder / "codes.json").read_text())
        self.codes = dict(zip(jobs, codes, strict=True))

    def text(self, name: str, rank: int, end: str) -> str:
        return (self.folder / f"{self.names.index(name)}.{rank}.{end}").read_text()

    def log(self, output: str) -> np.ndarray:
        """The log in the folder `output`, without the times.

        And without the steps of solves: one that was cut off has begun nearer to its end.
        """
        with (self.folder / output / "loss.csv").open() as stream:
            rows = [
                row | {"seconds": "0", "forward_iterations": "0"} for row in csv.DictReader(stream)
            ]
        return np.array([[float(cell or 0) for cell in row.values()] for row in rows])

    def found(self, output: str) -> dict[str, np.ndarray]:
        """All that a run found."""
        path = self.folder / output
        numbers = json.loads((path / "parameters.json").read_text())
        fields = {name: np.load(path / f"volumes/{name}.npz")[name] for name in FIELDS}
        views = {
            name: np.ravel(value["matrix"] if isinstance(value, dict) else value)
            for name, value in numbers.items()
        }
        return fields | views

    def compare(self, output: str, alone: str) -> None:
        """Asserts that a run found what another did, to rounding, all the way."""
        np.testing.assert_allclose(self.log(output), self.log(alone), rtol=1e-7)
        expected, found = self.found(alone), self.found(output)
        assert expected.keys() == found.keys()
        assert {"views.c.exposure", "views.d.camera"} <= found.keys()
        for name, value in expected.items():
            np.testing.assert_allclose(found[name], value, rtol=1e-6, atol=1e-8, err_msg=name)


def run_jobs(folder: Path, jobs: Mapping[str, Job]) -> Runs:
    """What becomes of `jobs`, one after the other in `folder`, with the scene in it."""
    write_scene(folder)
    script = Path(__file__).with_name("forked.py")
    known = {name: os.environ[name] for name in ("PATH", "HOME") if name in os.environ}
    known["PYTHONPATH"] = os.pathsep.join(sys.path)
    subprocess.run(
        [sys.executable, str(script), json.dumps(list(jobs.values())), str(folder)],
        cwd=folder,
        # The last as commands set it, before they import torch.
        env=known | {"OMP_NUM_THREADS": "1", "TORCH_CPP_LOG_LEVEL": "FATAL"},
        check=True,
    )
    return Runs(folder, jobs)
