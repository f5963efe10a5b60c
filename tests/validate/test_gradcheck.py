"""The derivative check passes for every kind of parameter, and catches each that is wrong."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from media import half_empty, make_camera, make_scene
from torch.autograd import Function

from ddrecon.diffusion import implicit
from ddrecon.errors import UsageError
from ddrecon.grid import Grid
from ddrecon.scene_file.build import load_scene
from ddrecon.validate import gradcheck
from ddrecon.validate.gradcheck import TOGETHER, check_parameters
from ddrecon.variables.values import variable_names

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("few_directions")]

CONFIG = Path(__file__).parents[2] / "configs" / "gradcheck_all.yaml"
SIZES = ([7, 6], [6, 5], [5, 6], [6, 5])
SMALL = ["volume.resolution=[6, 5, 4]", "lights.2.directions=3"]
SMALL += [f"views.{index}.camera.resolution={size}" for index, size in enumerate(SIZES)]
NAMES = tuple(load_scene(CONFIG).starts)
ONE_ROUND = "diffusion.transport_rounds=1", "diffusion.degree=1"


def check(name, samples=0, overrides=ONE_ROUND):
    """Of one view, above a ground for its number alone, under the light whose number it is."""
    scene = load_scene(CONFIG, overrides=[*SMALL, *overrides], dtype=torch.float64)
    seen = name.split(".")[1] if name.startswith("views.") else "front"
    ground = scene.ground if name.startswith("ground.") else None
    lights, starts = scene.lights[:2], scene.starts
    if name.startswith("lights."):
        _, index, number = name.split(".")
        lights, starts = [scene.lights[int(index)]], {f"lights.0.{number}": scene.starts[name]}
        name = f"lights.0.{number}"
    scene = replace(scene, views=[scene.view(seen)], ground=ground, lights=lights)
    known = variable_names(scene)
    scene.starts = {one: start for one, start in starts.items() if one in known}
    return check_parameters(scene, (name,), samples, 0)["checks"]


# Longer steps ask for a medium that makes light, and such systems have no solution.
WHITE = "volume.sigma_a=0", "volume.sigma_s=1e3", "diffusion.transport_rounds=0"
WHITE += "lights=[{type: ambient, radiance: 1}]", "optimize={parameters: {albedo: {}}}"
CASES = [(name, () if name == "g" else ONE_ROUND) for name in NAMES if name != "density"]
CASES += [("sigma_t", ONE_ROUND), ("albedo", ONE_ROUND), ("albedo", WHITE)]
CASES += [("density", (*ONE_ROUND, "volume.resolution=[1, 1, 1]"))]
CASES += [("g", (f"optimize.parameters.g={{init: {g}}}",)) for g in (0.8, -0.6)]
CASES += [("g", ("optimize.parameters.g={init: -0.6, field: true}",))]


@pytest.mark.parametrize(("name", "overrides"), CASES)
def test_every_parameter_passes(name, overrides):
    """Of the other pair of cross sections, of thick cells, of one, and of each cell as well."""
    (result,) = check(name, overrides=overrides)
    assert result["passed"], result
    assert overrides is WHITE or any(entry["adjoint"] != 0 for entry in result["entries"])


def test_all_at_once_pass(monkeypatch):
    overrides = [*SMALL, *ONE_ROUND]
    scene = load_scene(CONFIG, overrides=overrides, dtype=torch.float64)
    # None of them alone: `test_every_parameter_passes` checks those.
    monkeypatch.setattr(gradcheck, "show_progress", lambda names, _: names[:0])
    (result,) = check_parameters(scene, NAMES, 0, 0)["checks"]
    assert result["parameter"] == TOGETHER
    assert result["passed"], result


def test_density_passes_in_empty_cells_as_well():
    (result,) = check("density", samples=4)
    assert result["passed"], result
    values = [e["value"] for e in result["entries"] if e["value"] is not None]
    assert {value == 0 for value in values} == {True, False}


def test_rays_and_beams_along_the_axes_of_the_lattice_pass():
    """Through centers of cells, where differences are not what a slope to one side is."""
    camera = make_camera((0.0, 0.0, 3.0), (9, 7), is_perspective=False)
    grid = Grid((9, 7, 9), (-0.5, -0.6, -0.4), (0.5, 0.6, 0.4))
    scene = make_scene(half_empty(*grid.shape), travel=(0.0, -1.0, 0.0), camera=camera, grid=grid)
    names = "views.view.camera", "lights.0.direction"
    for result in check_parameters(scene, names, 2, 0)["checks"]:
        assert result["passed"], result


def test_an_unknown_parameter_is_refused():
    with pytest.raises(UsageError, match=r"no such number; did you mean 'density'"):
        check("densty")


BROKEN = {
    "the solve's adjoint": (implicit.ImplicitSolve, "backward", "density"),
    "the solve's tangent": (implicit.ImplicitSolve, "jvp", "density"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_derivative_one_percent_off_is_caught(monkeypatch, case):
    owner, mode, parameter = BROKEN[case]
    right = getattr(owner, mode)
    monkeypatch.setattr(owner, mode, staticmethod(lambda *arguments: _off(right(*arguments))))
    assert issubclass(owner, Function) and not check(parameter)[0]["passed"]


def _off(result):
    if isinstance(result, tuple):
        return tuple(_off(entry) for entry in result)
    return 1.01 * result if isinstance(result, torch.Tensor) else result
