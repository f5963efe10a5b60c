"""Small scenes at the edges of what is allowed, run and judged: `CASES` is the table.

Scenes are written in double precision and rounded once, as by the loader. Results must be finite,
the same in single and double precision, solved as far as rounding allows, lose no light and have no
radiance below zero.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

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
    lines = [(2 * torch.arange(n, dtype=torch.float64) + 1) / n - 1 for n in shape]
    z, y, x = torch.meshgrid(*lines, indexing="ij")
    return (1 - (z**2 + y**2 + x**2) / 0.8).clamp(min=0)


def layer(shape: Shape) -> Tensor:
    """A layer across y amid a haze a million times thinner."""
    density = torch.full(shape, 1e-6, dtype=torch.float64)
    density[:, shape[1] // 4 : shape[1] - shape[1] // 4] = 1
    return density


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
        volume = Volume(
            grid,
            self.density(self.shape).to(device, dtype),
            tensor([sigma_t * (1 - self.albedo)]),
            tensor([sigma_t * self.albedo]),
            HenyeyGreenstein(tensor(self.g)),
        )
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


SLAB = 1 / 24
BAR = 1 / 32

CASES: dict[str, HardCase] = {
    "vacuum": HardCase(torch.zeros),
    "vacuum, g 0.9, ambient light": HardCase(torch.zeros, g=0.9, ambient=0.5),
    "density jumps by 1e6": HardCase(layer, depth=10),
    "density jumps by 1e6, albedo 1, g 0.7": HardCase(layer, depth=10, albedo=1, g=0.7),
    **{
        f"optical depth 1e{power:+d} a cell": HardCase(torch.ones, depth=10.0**power)
        for power in (-8, -4, -2, 0, 1, 2, 4)
    },
    "optical depth 1e+4 a cell, albedo 1": HardCase(torch.ones, depth=1e4, albedo=1),
    "optical depth 1e+4 a cell, ball in vacuum": HardCase(ball, depth=1e4),
    "albedo 0": HardCase(depth=3, albedo=0, ambient=0.5, shape=(8, 8, 8)),
    "albedo 1": HardCase(depth=3, albedo=1),
    "albedo 1 - 1e-7": HardCase(depth=3, albedo=1 - 1e-7),
    "g 0.99": HardCase(depth=3, g=0.99),
    "g -0.99": HardCase(depth=3, g=-0.99),
    "g 0.99, albedo 1, full box": HardCase(torch.ones, depth=10, albedo=1, g=0.99),
    "g 0.99, density jumps by 1e6": HardCase(layer, depth=100, albedo=0.5, g=0.99),
    "g -0.99, density jumps by 1e6": HardCase(
        layer, depth=0.2, albedo=0.5, g=-0.99, eye=(0.1, 2.5, 0.3)
    ),
    "thin slab, 1 cell along x": HardCase(shape=(24, 24, 1), sides=(1, 1, SLAB), g=0.4),
    "thin slab, 1 cell along z": HardCase(shape=(1, 24, 24), sides=(SLAB, 1, 1), depth=40, g=0.4),
    "long box, 256 x 8 x 8": HardCase(
        torch.ones, shape=(8, 8, 256), sides=(BAR, BAR, 1), albedo=0.999, eye=(0.3, 0.5, 1.5)
    ),
    "long box, light and view along it": HardCase(
        torch.ones,
        shape=(8, 8, 256),
        sides=(BAR, BAR, 1),
        albedo=0.999,
        travel=(-1, 0, 0),
        eye=(1.5, 0, 0),
        half_width=0.03,
    ),
    "voxels 1 : 5 : 0.2": HardCase(sides=(1, 5, 0.2), depth=0.3, g=0.4),
    "voxels 1 : 10 : 0.1": HardCase(sides=(1, 10, 0.1), depth=0.3, g=0.4),
    "light along +x": HardCase(travel=(1, 0, 0), g=0.4),
    "light along -y": HardCase(travel=(0, -1, 0), g=0.4),
    "light a millionth off -z": HardCase(travel=(1e-6, 0, -1), g=0.4),
    "camera inside the medium": HardCase(eye=(0.1, 0.12, 0.11), half_width=1, g=0.4),
    "camera at a grazing angle": HardCase(
        torch.ones, eye=(3, 0.505, 0), target=(0, 0.499, 0), half_width=0.2, g=0.4
    ),
    "camera in the plane of a face": HardCase(
        torch.ones, eye=(3, 0.5, 0), target=(0, 0.5, 0), half_width=0.5, is_perspective=False
    ),
}


SINGLE_FROM_DOUBLE = 1e-4
"""Relative RMS error of images, and of gradients, in float32 against float64."""
OPAQUE = 400.0
"""Optical depths of a box beyond which errors may grow as these do: light is then seen where it
comes in, and float32 knows that place to two roundings, 2e-7 of the box.
"""
ROUNDINGS = 8
"""Residuals may exceed the tolerance by so many times what rounding the solution makes of them."""
ENERGY = {torch.float32: 1e-4, torch.float64: 1e-10}
NEGATIVE = 1e-7
"""How far below zero radiance may be, as a part of the brightest pixel."""


@dataclass(frozen=True)
class HardNumbers:
    """What is measured of a case; `iterations` to `energy` are of float32.

    Errors are relative RMS, absolute where nothing is; `lowest` is a part of the brightest pixel.
    """

    iterations: int
    residual: float
    attainable: float
    image_error: float
    gradient_error: float
    lowest: float
    energy: float
    energy_double: float
    depth: float

    def failures(self) -> list[str]:
        """The bounds that are not kept; a NaN keeps none."""
        single = SINGLE_FROM_DOUBLE * max(1, self.depth / OPAQUE)
        is_balanced = self.energy <= ENERGY[torch.float32]
        bounds = {
            "residual": self.residual <= TOLERANCE[torch.float32] + ROUNDINGS * self.attainable,
            "image": self.image_error <= single,
            "gradient": self.gradient_error <= single,
            "radiance": self.lowest >= -NEGATIVE,
            "energy": is_balanced and self.energy_double <= ENERGY[torch.float64],
        }
        return [name for name, is_kept in bounds.items() if not is_kept]


def run_cases(device: torch.device, progress: Progress) -> dict[str, Any]:
    """The numbers of every case of `CASES`, and its failures, as plain values."""
    cases = dict[str, dict[str, Any]]()
    for name in progress(list(CASES), "hard cases"):
        try:
            numbers = run_case(CASES[name], device)
            cases[name] = asdict(numbers) | {"failures": numbers.failures()}
        except SolveError as error:
            cases[name] = {"failures": [str(error)]}
    return {"passed": not any(case["failures"] for case in cases.values()), "cases": cases}


def run_case(case: HardCase, device: torch.device) -> HardNumbers:
    """What is measured of `case`, rendered in both precisions; SolveError where one gives up."""
    (image, gradient, iterations, balance), (exact, exact_gradient, _, exact_balance) = (
        _render(case, dtype, device) for dtype in (torch.float32, torch.float64)
    )
    return HardNumbers(
        iterations=iterations,
        **asdict(balance),
        image_error=relative_error(image, exact),
        gradient_error=relative_error(gradient, exact_gradient),
        lowest=float(image.min() / image.max().clamp(min=torch.finfo(image.dtype).tiny)),
        energy_double=exact_balance.energy,
        depth=case.depth * max(case.shape),
    )


def hard_lines(report: Mapping[str, Any]) -> list[str]:
    """The report of `run_cases` as a table, and how many cases failed."""
    names, rows = [key.name for key in fields(HardNumbers)], list[list[str]]()
    for name, case in report["cases"].items():
        numbers = [f"{case[key]:.2g}" if key in case else "" for key in names]
        failures = ", ".join(case["failures"])
        rows.append([name, *numbers, f"FAIL: {failures}" if failures else "pass"])
    failed = sum(bool(case["failures"]) for case in report["cases"].values())
    head = ["case", *(name.replace("_", " ") for name in names), "verdict"]
    return [*table_lines(head, rows), f"{len(rows)} cases, {failed} failed"]


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


@dataclass(frozen=True)
class Balance:
    """How far a solution is from balance (E2.4, E2.6, E2.7); all are 0 where there is no source.

    `residual`: |b - A u| / |b| in the scaling to a unit diagonal that solvers stop by, of b - A u
    itself, which iterations update rather than compute; `attainable`: what rounding u makes of it;
    `energy`: (injected - absorbed - leaked) / injected, each summed over all cells or faces.
    """

    residual: float = 0.0
    attainable: float = 0.0
    energy: float = 0.0


def balance_of(scene: Scene, solution: Tensor) -> Balance:
    """The balance of `solution`, L0 [C, z, y, x], in `scene` with beams and ambient light."""
    grid, settings = scene.volume.grid, scene.diffusion
    medium = scale_medium(scene.volume, settings.angles)
    cells = average_cells(medium)
    lights = decompose_lights(scene.lights)
    problem = DiffusionProblem(
        cells,
        Closure(settings.closure, grid),
        cut(receive_in_parts(medium, cells, lights, settings).source)[0],
        ambient_radiance(lights, solution),
        cells.degree > 0,
    )
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
