"""Small random media, operators, cameras and scenes, as factories: every test states what matters
to it and nothing else.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import torch
from click.testing import CliRunner, Result
from torch import Tensor

from ddrecon.cameras import Camera, look_at
from ddrecon.cli.commands import main
from ddrecon.diffusion.operator import AXES, Operator, boundary_loss, conductance
from ddrecon.grid import Grid
from ddrecon.io.volumes.table import FORMATS
from ddrecon.light.lights import AmbientLight, DirectionalLight
from ddrecon.medium.coefficients import Volume
from ddrecon.scene import Scene, View
from ddrecon.settings import DiffusionSettings, RenderSettings

os.environ["OMP_NUM_THREADS"] = "1"
torch.set_num_threads(1)  # tests run side by side, one a core

LOWER, UPPER = (-0.5, -0.6, -0.4), (0.5, 0.6, 0.5)
"""A box, in array order, whose cells are not cubes."""


def _random(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(
        dtype
    )


def _half_empty(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return (2 * _random(*shape, seed=seed, dtype=dtype) - 1).clamp(min=0)


def _box(shape: tuple[int, int, int]) -> Grid:
    return Grid(shape, LOWER, UPPER)


def _camera(
    eye: tuple[float, float, float] = (0.2, 0.3, 2.5),
    size: tuple[int, int] = (4, 5),
    half_width: float = 0.3,
    *,
    is_perspective: bool = True,
    **kind: Any,
) -> Camera:
    """A camera at `eye` (x, y, z) looking at the origin."""
    origin = torch.tensor(eye, dtype=kind.get("dtype", torch.float64))
    return Camera(
        look_at(origin, torch.zeros_like(origin), origin.new_tensor([0.0, 1.0, 0.0])),
        size,
        half_width,
        is_perspective,
    )


def _scene(
    density: Tensor,
    *,
    sigma_a: Any = (0.5, 1.0, 2.0),
    sigma_s: Any = (8.0, 6.0, 4.0),
    g: float = 0.0,
    directional: tuple[float, ...] | None = (3.0,),
    travel: tuple[float, float, float] = (-2.0, -2.0, -1.0),
    ambient: tuple[float, ...] | None = None,
    camera: Camera | None = None,
    grid: Grid | None = None,
    **diffusion: Any,
) -> Scene:
    """A scene in the precision of `density`, solved as closely as that precision allows; lights
    that are None are left out.
    """
    grid = grid or _box((density.shape[0], density.shape[1], density.shape[2]))
    tensor = density.new_tensor
    sigma_a, sigma_s = (
        sigma if isinstance(sigma, Tensor) else tensor(sigma) for sigma in (sigma_a, sigma_s)
    )
    lights: list[Any] = (
        [DirectionalLight(tensor(travel), tensor(directional))] if directional else []
    )
    lights += [AmbientLight(tensor(ambient))] if ambient else []
    camera = camera or _camera(dtype=density.dtype)
    diffusion = {"tolerance": 1e-13 if density.dtype == torch.float64 else 1e-6} | diffusion
    return Scene(
        Volume(grid, density, sigma_a, sigma_s, tensor(g)),
        lights,
        [View("view", camera)],
        RenderSettings(),
        DiffusionSettings(**diffusion),
    )


def _operator(grid: Grid, diffusion: Tensor, absorption: Tensor) -> Operator:
    z, y, x = (conductance(diffusion, grid, axis) for axis in AXES)
    return Operator((z, y, x), absorption + boundary_loss(diffusion, grid))


def _dense(operator: Operator) -> Tensor:
    """The matrix `[C, n, n]` of `operator`, written with loops and flat indices: a slow twin that
    shares no code with it.
    """
    colors, *shape = operator.loss.shape
    strides = (shape[1] * shape[2], shape[2], 1)
    matrix = torch.zeros(colors, math.prod(shape), math.prod(shape), dtype=operator.loss.dtype)
    for cell in range(math.prod(shape)):
        place = [cell // strides[0], cell // strides[1] % shape[1], cell % shape[2]]
        matrix[:, cell, cell] += operator.loss[:, place[0], place[1], place[2]]
        for axis in range(3):
            if place[axis] + 1 == shape[axis]:
                continue
            conductance, neighbor = (
                operator.conductances[axis][:, place[0], place[1], place[2]],
                cell + strides[axis],
            )
            matrix[:, cell, cell] += conductance
            matrix[:, neighbor, neighbor] += conductance
            matrix[:, cell, neighbor] -= conductance
            matrix[:, neighbor, cell] -= conductance
    return matrix


def _order(steps: list[float], errors: list[float]) -> float:
    """The slope of log error against log step: the order of convergence."""
    x, y = (
        torch.tensor(steps, dtype=torch.float64).log(),
        torch.tensor(errors, dtype=torch.float64).log(),
    )
    x = x - x.mean()
    return float((x * y).sum() / (x * x).sum())


def _factory(function: Callable[..., Any]) -> Any:
    return pytest.fixture(scope="session")(lambda: function)


random = _factory(_random)
half_empty = _factory(_half_empty)
box = _factory(_box)
make_camera = _factory(_camera)
make_scene = _factory(_scene)
make_operator = _factory(_operator)
dense = _factory(_dense)
order = _factory(_order)


@pytest.fixture(autouse=True)
def same_seed() -> None:
    """No test depends on those before it: which views an iteration looks at follows from the seed."""
    torch.manual_seed(0)


PACKAGES = {
    ".vdb": ("openvdb", "pyopenvdb"),
    ".tif": ("tifffile",),
    ".tiff": ("tifffile",),
    ".nc": ("netCDF4",),
}
"""What reading a format needs: one of these."""


def _is_readable(suffix: str) -> bool:
    return suffix not in PACKAGES or any(find_spec(name) for name in PACKAGES[suffix])


@pytest.fixture(scope="session")
def readable_formats() -> list[str]:
    """The suffixes of all volume files that can be read here."""
    return [suffix for suffix in FORMATS if _is_readable(suffix)]


@pytest.fixture(scope="session", params=FORMATS)
def suffix(request: pytest.FixtureRequest) -> str:
    """The suffix of each kind of volume file that can be read here."""
    if not _is_readable(request.param):
        pytest.skip(
            f"reading {request.param} needs {' or '.join(PACKAGES[request.param])}, not installed here"
        )
    return request.param


@pytest.fixture
def run(folder: Path) -> Callable[..., Result]:
    """Runs a command in the current folder, which the fixture `folder` of the tests has made; a
    bug's exception is not swallowed.
    """

    def run_command(*arguments: str) -> Result:
        result = CliRunner().invoke(main, [os.fspath(argument) for argument in arguments])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result

    return run_command
