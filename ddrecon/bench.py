"""`ddrecon bench`: time against error of every choice a scene leaves open, and hard cases.

Of the first, an image and the gradient of its mean by density are measured; variants take turns.
The numerical error is against the same model solved exactly, in double precision; the whole error
is against path tracing by Mitsuba 3, where that is installed.

Hard cases are small scenes at the edges of what is allowed: `CASES` is the table. They are written
in double precision and rounded once, as by the loader. Results must be finite, the same in single
and double precision, solved as far as rounding allows, lose no light and have no radiance below
zero. The plume, which is measured, is in the same words.
"""

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from statistics import median
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.cameras import Camera, look_at
from ddrecon.diffusion.cells import average_cells
from ddrecon.diffusion.closures import CLOSURES, Closure
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
from ddrecon.picture import render_each
from ddrecon.progress import show_progress, table_lines
from ddrecon.reconstruct.setup import scene_at_level
from ddrecon.reference.trace import Traced, Tracer, error_text
from ddrecon.scene import Scene, View
from ddrecon.settings import DiffusionSettings, RenderSettings
from ddrecon.variables.values import with_values

TURNS = 2
PATHS, QUICK_PATHS = (4, 16, 64), (4, 16)
"""Paths a pixel that Mitsuba is tried with."""
TRUTH_PASSES, TRUTH_SEED = 4, 1000
"""The truth is the mean of so many images of the most paths, whose seeds begin here."""
QUICK_CELLS = 60_000
"""A quick bench is of a scene made coarser until it has no more cells than this."""
SPEED_COLUMNS = {"name": "", "image_seconds": ".3f", "both_seconds": ".3f", "times_base": ".2f"}
SPEED_COLUMNS |= {"iterations": "", "image_numerical": ".1e", "gradient_numerical": ".1e"}
SPEED_COLUMNS |= {"image_error": "", "best": ""}


@dataclass(frozen=True)
class Shot:
    """One image [3, h, w] of a scene's first view, and the `gradient` [z, y, x] of its mean by
    density, empty of path tracing. `iterations` are the first solve's, or samples a pixel.
    """

    image: Tensor
    gradient: Tensor
    image_seconds: float
    gradient_seconds: float
    iterations: int


def load_pair(
    load: Callable[[torch.dtype], Scene] | None, device: torch.device, is_quick: bool
) -> tuple[Scene, Scene]:
    """The scene that `load` gives, or else the plume, with one view: in float32 and in float64."""

    def load_one(dtype: torch.dtype) -> Scene:
        if load is None:
            cells, pixels = (32, 128) if is_quick else (64, 256)
            return plume_scene(cells, pixels, dtype, device)
        scene, factor = load(dtype), 1
        while is_quick and scene.volume.grid.cells / factor**3 > QUICK_CELLS:
            factor += 1
        return replace(scene_at_level(scene, factor), views=scene.views[:1])

    return load_one(torch.float32), load_one(torch.float64)


def variants_of(scene: Scene, is_quick: bool) -> dict[str, Scene]:
    """`scene` by name: as it is, then by other settings, one at a time; fewer if it `is_quick`."""
    exactness = (1e-2, 1e-4, 1e-6) if is_quick else (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)
    rounds = (0, 3), (1, 3), (2, 3), *(() if is_quick else ((4, 3), (2, 5)))
    changes: dict[str, dict[str, Any]] = {"rounds by the medium": {"transport_rounds": None}}
    changes |= {f"tolerance {tolerance}": {"tolerance": tolerance} for tolerance in exactness}
    changes |= {f"closure {closure}": {"closure": closure} for closure in CLOSURES}
    for count, degree in rounds:
        change = {"transport_rounds": count, "degree": degree}
        changes[f"rounds {count}, degree {degree}"] = change
    of_rays: dict[str, dict[str, Any]] = {f"steps {n}": {"steps_per_voxel": n} for n in (1, 2)}
    for tolerance in (0, 0.05) if is_quick else (0, 0.01, 0.05, 1):
        of_rays[f"pixels {tolerance}"] = {"tolerance": tolerance}
    variants = {
        n: replace(scene, diffusion=replace(scene.diffusion, **changes[n])) for n in changes
    }
    variants |= {n: replace(scene, render=replace(scene.render, **of_rays[n])) for n in of_rays}
    for factor in (2,) if is_quick else (2, 4):
        coarse = replace(scene_at_level(scene, factor), views=scene.views)
        variants[f"grid {factor} times coarser"] = coarse
    base = _settings(scene)
    return {"base": scene} | {n: v for n, v in variants.items() if _settings(v) != base}


def _settings(scene: Scene) -> tuple[object, ...]:
    """What is varied; without the degree where there are no rounds that it could matter to."""
    diffusion = scene.diffusion
    if not diffusion.rounds:
        diffusion = replace(diffusion, degree=None)
    return scene.volume.grid.shape, scene.render, diffusion


def shoot(scene: Scene, memory: SolveMemory | None = None) -> Shot:
    """An image of the first view of `scene`, rendered from nothing, with its gradient.

    Solutions stay in an empty `memory`.
    """
    density = scene.volume.density.detach().clone().requires_grad_()
    varied, memory = with_values(scene, {"density": density}), memory or SolveMemory()
    start = _now(density)
    image = render_each(varied, varied.views[:1], memory)[0]
    middle = _now(density)
    (gradient,) = torch.autograd.grad(image.mean(), density)
    end = _now(density)
    iterations = memory.records[0].iterations if memory.records else 0
    return Shot(image.detach(), gradient, middle - start, end - middle, iterations)


def trace(tracer: Tracer, samples: int, seed: int = 0) -> Shot:
    """An image by so many paths a pixel."""
    start = perf_counter()
    image = torch.from_numpy(tracer.trace(0, seed, samples)).movedim(-1, 0)
    return Shot(image, image[:0], perf_counter() - start, 0.0, samples)


def run_bench(scene: Scene, double: Scene, tracer: Tracer | None, is_quick: bool) -> dict[str, Any]:
    """What every variant of `scene` and path tracing take and miss, as plain values.

    `double` is `scene` in double precision; without `tracer` there is no path tracing. Of the
    `rows`, seconds are medians, `both_seconds` of image and gradient, and errors relative RMS:
    `image_numerical` and `gradient_numerical` against the same model solved exactly, `image_error`
    against path tracing, whose noise, `truth_noise`, is subtracted in quadrature. A row is `best`
    where no other is known to be faster and as close to the truth.
    """
    contestants: dict[str, Callable[[], Shot]] = {
        name: partial(shoot, variant) for name, variant in variants_of(scene, is_quick).items()
    }
    exact, solved = dict[str, Shot](), dict[tuple[object, ...], Shot]()
    marching = replace(double.render, steps_per_voxel=max(3, double.render.steps), tolerance=0.0)
    for name, variant in show_progress([*variants_of(double, is_quick).items()], "exact solutions"):
        diffusion = replace(variant.diffusion, tolerance=1e-8, warm_start=False)
        as_exact = replace(variant, render=marching, diffusion=diffusion)
        key = _settings(as_exact)
        if key not in solved:  # alike ones are solved once
            solved[key] = shoot(as_exact)
        exact[name] = solved[key]
    truth = None
    if tracer is not None:
        paths = QUICK_PATHS if is_quick else PATHS
        seeds = range(TRUTH_SEED, TRUTH_SEED + TRUTH_PASSES)
        truth = Traced.of([trace(tracer, paths[-1], seed).image.numpy() for seed in seeds])
        for samples in paths:
            contestants[f"Mitsuba {samples} paths a pixel"] = partial(trace, tracer, samples)
    shots = measure(contestants, 1 if is_quick else TURNS)
    rows = [row_of(name, series, exact.get(name), truth) for name, series in shots.items()]
    mark_best(rows, 0.0 if truth is None else truth.noise)
    height, width = scene.views[0].camera.size
    return {
        "scene": {"cells": list(reversed(scene.volume.grid.shape)), "pixels": [width, height]},
        "truth_noise": None if truth is None else truth.noise,
        "rows": rows,
    }


def measure(contestants: Mapping[str, Callable[[], Shot]], turns: int) -> dict[str, list[Shot]]:
    """The shots by name of all `contestants` that can be solved.

    All run once in every turn, so that other work on the machine slows all alike. The first turn,
    in which kernels are compiled, is not counted.
    """
    shots: dict[str, list[Shot]] = {name: [] for name in contestants}
    schedule = [(turn, name) for turn in range(turns + 1) for name in contestants]
    for turn, name in show_progress(schedule, "bench"):
        if turn == len(shots[name]):
            with suppress(SolveError):
                shots[name].append(contestants[name]())
    return {name: series[1:] for name, series in shots.items() if series}


def row_of(
    name: str, shots: list[Shot], exact: Shot | None, truth: Traced | None
) -> dict[str, Any]:
    """The row of what took these `shots`; errors are None where nothing is to compare with."""
    shot, errors = shots[0], dict.fromkeys(("image_numerical", "gradient_numerical"))
    if exact is not None:
        errors["image_numerical"] = relative_error(shot.image, exact.image)
        errors["gradient_numerical"] = relative_error(shot.gradient, exact.gradient)
    return {
        "name": name,
        "image_seconds": median(shot.image_seconds for shot in shots),
        "both_seconds": median(shot.image_seconds + shot.gradient_seconds for shot in shots),
        "iterations": shot.iterations,
        **errors,
        "image_error": None if truth is None else truth.error(shot.image.numpy()),
    }


def mark_best(rows: list[dict[str, Any]], noise: float) -> None:
    """Marks the `rows` that no other beats in both time of an image and error (Pareto).

    An error against path tracing is at least what its `noise` can tell from none.
    """

    def error(row: dict[str, Any]) -> float:
        if row["image_error"] is not None:
            return max(row["image_error"], noise / 3)
        return math.inf if row["image_numerical"] is None else row["image_numerical"]

    for row in rows:
        faster = (other for other in rows if other["image_seconds"] < row["image_seconds"])
        row["best"] = "yes" if all(error(other) > error(row) for other in faster) else None


def bench_lines(report: Mapping[str, Any]) -> list[str]:
    """The report as a Markdown table, and Mitsuba's time; times are multiples of the base's."""
    rows, noise, base = list[dict[str, Any]](), report["truth_noise"], report["rows"][0]
    for row in report["rows"]:
        times = row["both_seconds"] / base["both_seconds"]
        error = None if noise is None else error_text(row["image_error"], noise)
        rows.append(row | {"times_base": times, "image_error": error})
    lines = table_lines(SPEED_COLUMNS, rows)
    if noise is not None:
        times = rows[-1]["image_seconds"] / base["image_seconds"]
        lines.append(
            f"image error is against path tracing, whose noise, {noise:.2g}, is subtracted; "
            f"{rows[-1]['name']} take {times:.3g} times as long as base"
        )
    return lines


def _now(like: Tensor) -> float:
    """The time, once the device has done what it was given."""
    if like.is_cuda:
        torch.cuda.synchronize(like.device)
    return perf_counter()


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
NO_LIGHT = {"residual": 0.0, "attainable": 0.0, "energy": 0.0}
"""The balance of a solution without a source."""
SMALLEST = torch.finfo(torch.float32).tiny
HARD_COLUMNS = {"case": "", **dict.fromkeys(NUMBERS, ".2g"), "verdict": ""}
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


def run_cases(device: torch.device) -> dict[str, Any]:
    """The report of every case of `CASES`, and whether all have passed."""
    cases = {
        name: run_case(CASES[name], device) for name in show_progress(list(CASES), "hard cases")
    }
    return {"passed": not any(case["failures"] for case in cases.values()), "cases": cases}


def run_case(case: HardCase, device: torch.device) -> dict[str, Any]:
    """The numbers of `case`, rendered in both precisions, and its `failures`; these alone where a
    solve gives up.
    """
    scenes = [case.scene(dtype, device) for dtype in TOLERANCE]
    memories = [SolveMemory() for _ in scenes]
    try:
        shot, exact = map(shoot, scenes, memories)
    except SolveError as error:
        return {"failures": [str(error)]}
    balance, balance_double = (
        balance_of(scene, memory.last["forward", 0]) if memory.records else NO_LIGHT
        for scene, memory in zip(scenes, memories, strict=True)
    )
    numbers = {
        **balance,
        "iterations": sum(r.iterations for r in memories[0].records if r.kind != "rounds"),
        "image_error": relative_error(shot.image, exact.image),
        "gradient_error": relative_error(shot.gradient, exact.gradient),
        "lowest": float(shot.image.min() / shot.image.max().clamp(min=SMALLEST)),
        "energy_double": balance_double["energy"],
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
    return [*table_lines(HARD_COLUMNS, rows), f"{len(rows)} cases, {failed} failed"]


def relative_error(rounded: Tensor, exact: Tensor) -> float:
    """The relative RMS error of `rounded`, absolute where `exact`, of float64, is zero."""
    size = exact.norm()
    return float((rounded.double() - exact).norm() / torch.where(size > 0, size, 1))


def balance_of(scene: Scene, solution: Tensor) -> dict[str, float]:
    """How far `solution`, L0 [C, z, y, x], is from balance in `scene` (E2.4, E2.6, E2.7).

    `residual`: |b - A u| / |b| in the scaling to a unit diagonal that solvers stop by, of b - A u
    itself, which iterations update rather than compute; `attainable`: what rounding u makes of it;
    `energy`: (injected - absorbed - leaked) / injected, each summed over all cells or faces.
    """
    grid, settings = scene.volume.grid, scene.diffusion
    medium = scale_medium(scene.volume, settings.angles)
    cells, lights = average_cells(medium), decompose_lights(scene.lights)
    source = cut(receive_in_parts(medium, cells, lights, settings).source)[0]
    closure = Closure(settings.closure, grid)
    outside = ambient_radiance(lights, solution)
    problem = DiffusionProblem(cells, closure, source, outside, cells.degree > 0)
    operator, right = problem.system
    if not right.any():
        return NO_LIGHT
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
    return {"residual": residual, "attainable": float(rounding / size), "energy": energy}


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
