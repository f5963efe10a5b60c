"""Small scenes at the edges of what is allowed, run and judged: `CASES` is the table.

Scenes are written in double precision and rounded once, as by the loader. Results must be finite,
the same in single and double precision, solved as far as rounding allows, lose no light and have no
radiance below zero. The plume, which is measured, is in the same words.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ddrecon.cameras import Camera, look_at
from ddrecon.diffusion.cells import average_cells
from ddrecon.diffusion.closures import Closure
from ddrecon.diffusion.conservative import DiffusionProblem
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.diffusion.operator import boundary_loss
from ddrecon.errors import SolveError
from ddrecon.grid import Grid, Triple
from ddrecon.light.lights import AmbientLight, DirectionalLight, Light
from ddrecon.light.moments import cut
from ddrecon.light.reduced import ambient_radiance
from ddrecon.light.sky import decompose_lights
from ddrecon.light_field import receive_in_parts
from ddrecon.medium.coefficients import Volume, scale_medium
from ddrecon.medium.phase import HenyeyGreenstein
from ddrecon.picture import render
from ddrecon.progress import Progress, table_lines
from ddrecon.scene import Scene, View
from ddrecon.settings import DiffusionSettings, RenderSettings

Shape = tuple[int, int, int]
TOLERANCE = {torch.float32: 1e-6, torch.float64: 1e-12}
"""Relative residual asked of the solves: small against the bounds of a case, and within what each
precision can reach.
"""


def ball(shape: Shape) -> Tensor:
    """A soft ball, or what it becomes in a box that is no cube, with vacuum around it."""
    z, y, x = (2 * place for place in _centers(shape))
    return (1 - (z**2 + y**2 + x**2) / 0.8).clamp(min=0)


def layer(shape: Shape) -> Tensor:
    """A layer across y amid a haze a million times thinner."""
    density = torch.full(shape, 1e-6, dtype=torch.float64)
    density[:, shape[1] // 4 : shape[1] - shape[1] // 4] = 1
    return density


def _centers(shape: Shape) -> tuple[Tensor, ...]:
    """Where along z, y and x each cell lies in a box from -0.5 to 0.5."""
    lines = [(torch.arange(n, dtype=torch.float64) + 0.5) / n - 0.5 for n in shape]
    return torch.meshgrid(*lines, indexing="ij")


@dataclass(frozen=True)
class HardCase:
    """A scene in words: a medium in a box about the origin, a sun, and a camera.

    The box has `shape` cells and `sides` [u], in array order; `depth`: optical depth of a cell of
    density 1 along its shortest side. `travel`, `eye` and `target` are (x, y, z).
    """

    density: Callable[[Shape], Tensor] = ball
    depth: float = 1.0
    albedo: float = 0.9
    g: float = 0.0
    shape: Shape = (16, 16, 16)
    sides: Triple = (1.0, 1.0, 1.0)
    travel: Triple = (-2.0, -2.0, -1.0)
    ambient: float = 0.0
    eye: Triple = (0.8, 0.9, 2.5)
    target: Triple = (0.0, 0.0, 0.0)
    half_width: float = 0.35
    is_perspective: bool = True
    pixels: int = 16

    def scene(self, dtype: torch.dtype, device: torch.device) -> Scene:
        """The scene in `dtype` on `device`, to be solved as closely as `TOLERANCE` says."""

        def tensor(values: float | Triple | list[float]) -> Tensor:
            return torch.tensor(values, dtype=torch.float64).to(device, dtype)

        z, y, x = (side / 2 for side in self.sides)
        grid = Grid(self.shape, (-z, -y, -x), (z, y, x))
        sigma_t = self.depth / min(grid.spacing)
        sigma_a, sigma_s = (tensor([sigma_t * share]) for share in (1 - self.albedo, self.albedo))
        density = self.density(self.shape).to(device, dtype)
        volume = Volume(grid, density, sigma_a, sigma_s, HenyeyGreenstein(tensor(self.g)))
        lights: list[Light] = [DirectionalLight(tensor(self.travel), tensor([3.0]))]
        if self.ambient:
            lights.append(AmbientLight(tensor([self.ambient])))
        pose = look_at(tensor(self.eye), tensor(self.target), tensor((0.0, 1.0, 0.0)))
        size = self.pixels, self.pixels
        views = [View("view", Camera(pose, size, self.half_width, self.is_perspective))]
        diffusion = DiffusionSettings(
            tolerance=TOLERANCE[dtype], transport_rounds=1, degree=3, refine=1
        )
        return Scene(volume, lights, views, RenderSettings(steps_per_voxel=1), diffusion)


FULL, LAYER = partial(HardCase, torch.ones), partial(HardCase, layer)
SLAB, BAR = 1 / 24, 1 / 32
LONG = partial(FULL, shape=(8, 8, 256), sides=(BAR, BAR, 1), albedo=0.999)
CASES: dict[str, HardCase] = {
    "vacuum": HardCase(torch.zeros),
    "vacuum, g 0.9, ambient light": HardCase(torch.zeros, g=0.9, ambient=0.5),
    "density jumps by 1e6": LAYER(depth=10),
    "density jumps by 1e6, albedo 1, g 0.7": LAYER(depth=10, albedo=1, g=0.7),
    **{
        f"optical depth 1e{power:+d} a cell": FULL(depth=10.0**power)
        for power in (-8, -4, -2, 0, 1, 2, 4)
    },
    "optical depth 1e+4 a cell, albedo 1": FULL(depth=1e4, albedo=1),
    "optical depth 1e+4 a cell, ball in vacuum": HardCase(depth=1e4),
    "albedo 0": HardCase(depth=3, albedo=0, ambient=0.5, shape=(8, 8, 8)),
    "albedo 1": HardCase(depth=3, albedo=1),
    "albedo 1 - 1e-7": HardCase(depth=3, albedo=1 - 1e-7),
    "g 0.99": HardCase(depth=3, g=0.99),
    "g -0.99": HardCase(depth=3, g=-0.99),
    "g 0.99, albedo 1, full box": FULL(depth=10, albedo=1, g=0.99),
    "g 0.99, density jumps by 1e6": LAYER(depth=100, albedo=0.5, g=0.99),
    "g -0.99, density jumps by 1e6": LAYER(depth=0.2, albedo=0.5, g=-0.99, eye=(0.1, 2.5, 0.3)),
    "thin slab, 1 cell along x": HardCase(shape=(24, 24, 1), sides=(1, 1, SLAB), g=0.4),
    "thin slab, 1 cell along z": HardCase(shape=(1, 24, 24), sides=(SLAB, 1, 1), depth=40, g=0.4),
    "long box, 256 x 8 x 8": LONG(eye=(0.3, 0.5, 1.5)),
    "long box, light and view along it": LONG(travel=(-1, 0, 0), eye=(1.5, 0, 0), half_width=0.03),
    "voxels 1 : 5 : 0.2": HardCase(sides=(1, 5, 0.2), depth=0.3, g=0.4),
    "voxels 1 : 10 : 0.1": HardCase(sides=(1, 10, 0.1), depth=0.3, g=0.4),
    "light along +x": HardCase(travel=(1, 0, 0), g=0.4),
    "light along -y": HardCase(travel=(0, -1, 0), g=0.4),
    "light a millionth off -z": HardCase(travel=(1e-6, 0, -1), g=0.4),
    "camera inside the medium": HardCase(eye=(0.1, 0.12, 0.11), half_width=1, g=0.4),
    "camera at a grazing angle": FULL(
        eye=(3, 0.505, 0), target=(0, 0.499, 0), half_width=0.2, g=0.4
    ),
    "camera in the plane of a face": FULL(
        eye=(3, 0.5, 0), target=(0, 0.5, 0), half_width=0.5, is_perspective=False
    ),
}
NUMBERS: tuple[str, ...] = ("iterations", "residual", "attainable", "image_error", "gradient_error")
NUMBERS += ("lowest", "energy", "energy_double", "depth")
"""The numbers of a case; the first, up to `energy`, are of float32.

Errors are relative RMS, absolute where nothing is; `lowest` is a part of the brightest pixel.
"""
COLUMNS = {"case": "", **dict.fromkeys(NUMBERS, ".2g"), "verdict": ""}
SINGLE_FROM_DOUBLE = 1e-4
"""Errors of images, and of gradients, in float32 against float64."""
OPAQUE = 400.0
"""Optical depths of a box beyond which errors may grow as these do: light is then seen where it
comes in, and float32 knows that place to two roundings, 2e-7 of the box.
"""
ROUNDINGS = 8
"""Residuals may exceed the tolerance by so many times what rounding the solution makes of them."""


def find_failures(numbers: Mapping[str, float]) -> list[str]:
    """The bounds that `numbers`, by the names of `NUMBERS`, do not keep; a NaN keeps none."""
    single = SINGLE_FROM_DOUBLE * max(1, numbers["depth"] / OPAQUE)
    most = TOLERANCE[torch.float32] + ROUNDINGS * numbers["attainable"]
    bounds = {
        "residual": numbers["residual"] <= most,
        "image": numbers["image_error"] <= single,
        "gradient": numbers["gradient_error"] <= single,
        "radiance": numbers["lowest"] >= -1e-7,
        "energy": numbers["energy"] <= 1e-4 and numbers["energy_double"] <= 1e-10,
    }
    return [name for name, is_kept in bounds.items() if not is_kept]


def run_cases(device: torch.device, progress: Progress) -> dict[str, Any]:
    """The report of every case of `CASES`, and whether all have passed."""
    cases = {name: run_case(CASES[name], device) for name in progress(list(CASES), "hard cases")}
    return {"passed": not any(case["failures"] for case in cases.values()), "cases": cases}


def run_case(case: HardCase, device: torch.device) -> dict[str, Any]:
    """The numbers of `case`, rendered in both precisions, and its `failures`; these alone where a
    solve gives up.
    """
    try:
        (image, gradient, iterations, balance), (exact, exact_gradient, _, exact_balance) = (
            _render(case, dtype, device) for dtype in TOLERANCE
        )
    except SolveError as error:
        return {"failures": [str(error)]}
    numbers: dict[str, float] = {
        **balance._asdict(),
        "iterations": iterations,
        "image_error": relative_error(image, exact),
        "gradient_error": relative_error(gradient, exact_gradient),
        "lowest": float(image.min() / image.max().clamp(min=torch.finfo(image.dtype).tiny)),
        "energy_double": exact_balance.energy,
        "depth": case.depth * max(case.shape),
    }
    return {**numbers, "failures": find_failures(numbers)}


def hard_lines(report: Mapping[str, Any]) -> list[str]:
    """The report of `run_cases` as a table, and how many cases failed."""
    rows = list[dict[str, Any]]()
    for name, case in report["cases"].items():
        failures = ", ".join(case["failures"])
        rows.append(case | {"case": name, "verdict": f"FAIL: {failures}" if failures else "pass"})
    failed = sum(bool(row["failures"]) for row in rows)
    return [*table_lines(COLUMNS, rows), f"{len(rows)} cases, {failed} failed"]


class Balance(NamedTuple):
    """How far a solution is from balance (E2.4, E2.6, E2.7); all are 0 where there is no source.

    `residual`: |b - A u| / |b| in the scaling to a unit diagonal that solvers stop by, of b - A u
    itself, which iterations update rather than compute; `attainable`: what rounding u makes of it;
    `energy`: (injected - absorbed - leaked) / injected, each summed over all cells or faces.
    """

    residual: float = 0.0
    attainable: float = 0.0
    energy: float = 0.0


def _render(
    case: HardCase, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, int, Balance]:
    """The image [3, h, w], the gradient of its mean by density [z, y, x], iterations, balance."""
    scene, memory = case.scene(dtype, device), SolveMemory()
    density = scene.volume.density.requires_grad_()
    image = render(scene, memory=memory)[0]
    (gradient,) = torch.autograd.grad(image.mean(), density)
    density.requires_grad_(False)
    balance = balance_of(scene, memory.last["forward", 0]) if memory.records else Balance()
    iterations = sum(r.iterations for r in memory.records if r.kind != "rounds")
    return image.detach(), gradient, iterations, balance


def relative_error(rounded: Tensor, exact: Tensor) -> float:
    """The relative RMS error of `rounded`, absolute where `exact`, of float64, is zero."""
    size = exact.norm()
    return float((rounded.double() - exact).norm() / torch.where(size > 0, size, 1))


def balance_of(scene: Scene, solution: Tensor) -> Balance:
    """The balance of `solution`, L0 [C, z, y, x], in `scene` with beams and ambient light."""
    grid, settings = scene.volume.grid, scene.diffusion
    medium = scale_medium(scene.volume, settings.angles)
    cells, lights = average_cells(medium), decompose_lights(scene.lights)
    source = cut(receive_in_parts(medium, cells, lights, settings).source)[0]
    closure = Closure(settings.closure, grid)
    outside = ambient_radiance(lights, solution)
    problem = DiffusionProblem(cells, closure, source, outside, cells.degree > 0)
    operator, right = problem.system
    if not right.any():
        return Balance()
    escape = boundary_loss(problem.diffusion, grid)
    injected = cells.remaining_scattering * problem.source[0] + escape * problem.outside
    # b sums to what is injected less what Q1 drives out of the box; between cells Q1 only moves.
    lost = (cells.absorption.value.double() + escape.double()) * solution.double()
    energy = float((right.double() - lost).sum().abs() / injected.double().sum())
    scale = operator.diagonal.rsqrt()
    size = (scale * right).norm()
    residual = float((scale * (right - operator.apply(solution))).norm() / size)
    # What rounding every entry of the solution by one unit in the last adds to it.
    rounding = torch.finfo(solution.dtype).eps * (scale * operator.diagonal * solution).norm()
    return Balance(residual, float(rounding / size), energy)


def plume_scene(cells: int, pixels: int, dtype: torch.dtype, device: torch.device) -> Scene:
    """A plume on `cells` x 1.5 `cells` x `cells` cells, seen by `pixels` x `pixels` pixels.

    Where it is densest it is about 8 optical depths thick.
    """
    plume = HardCase(
        lambda shape: plume_density(*reversed(_centers(shape))),
        depth=30 / cells,
        albedo=0.95,
        shape=(cells, cells * 3 // 2, cells),
        sides=(1.0, 1.5, 1.0),
        travel=(-2.0, -1.2, -0.5),
        eye=(0.0, 0.3, 3.2),
        half_width=math.tan(math.radians(15)),
        pixels=pixels,
    )
    scene = plume.scene(dtype, device)
    tolerance = DiffusionSettings.tolerance
    return replace(scene, diffusion=replace(scene.diffusion, tolerance=tolerance))


def plume_density(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Density at places from -0.5 to 0.5: a rising, widening, swaying and ragged column."""
    rise = y + 0.5
    away = torch.hypot(x - 0.1 * rise * torch.sin(7 * rise), z - 0.1 * rise * torch.cos(6 * rise))
    ragged = torch.sin(23 * x + 11 * y) * torch.sin(19 * y + 5 * z) * torch.sin(21 * z - 9 * x)
    column = fade(away + 0.05 * ragged, 0.12 + 0.2 * rise, 0.1)
    return column * fade(y.abs(), 0.46, 0.08) * (1 - 0.6 * rise)


def fade(distance: Tensor, outer: Tensor | float, width: float) -> Tensor:
    """1 below `outer` - `width`, falling smoothly to 0 at `outer`."""
    depth = ((outer - distance) / width).clamp(0, 1)
    return depth * depth * (3 - 2 * depth)
