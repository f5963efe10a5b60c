"""Checks of derivatives: tangent against adjoint, and adjoint against finite differences.

Everything runs in float64 with solves to nearly its precision, for every parameter alone and for
all of them at once.
"""

import contextlib
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import SolveError, UsageError, suggestion
from ddrecon.light_field import LightField
from ddrecon.lighting import solve_light
from ddrecon.losses import Target
from ddrecon.picture import view_picture
from ddrecon.progress import show_progress, table_lines
from ddrecon.scene import Scene
from ddrecon.variables.kinds import SHORT_STEPS, is_of_volume, kind_of
from ddrecon.variables.values import (
    component_names,
    density_names,
    value_of,
    variable_names,
    with_values,
)

AGREE_MODES, AGREE_DIFFERENCES = 1e-10, 1e-6
"""The largest errors that pass."""
CLOSE = 1e-8
"""The error of a difference below which no shorter step is tried."""
NEGLIGIBLE = 1e-6
"""Errors are relative to the derivative they are of, or to this part of the parameter's largest."""
TOGETHER = "all at once"
"""What the check of all parameters together is called."""
TINY = torch.finfo(torch.float64).tiny

Values = Mapping[str, Tensor]
Loss = Callable[[Values], Tensor]


COLUMNS = {"parameter": "", "verdict": "", "tangent_to_adjoint": ".1e", "differences": ".1e"}
COLUMNS |= {"entry": "", "step": ".1e", "adjoint": ".7e"}
ALLOWED = f"allowed: tangent to adjoint {AGREE_MODES:.0e}, differences {AGREE_DIFFERENCES:.0e}"


def lines(report: Mapping[str, Any]) -> list[str]:
    """The report of `check_parameters` as a table, with the worst entry of each check."""
    rows = list[dict[str, Any]]()
    for check in report["checks"]:
        worst = max(check["entries"], key=lambda entry: entry["error"])
        row = check | worst | {"verdict": "pass" if check["passed"] else "FAIL"}
        errors = {"tangent_to_adjoint": check["modes_error"], "differences": worst["error"]}
        rows.append(row | errors)
    return [*table_lines(COLUMNS, rows), f"errors are relative; {ALLOWED}"]


def check_parameters(
    scene: Scene, names: tuple[str, ...], samples: int, seed: int
) -> dict[str, Any]:
    """The `checks` of the parameters `names` of `scene` (float64), and of all of them at once.

    Without names it is what the scene optimizes, or density where that is nothing. Of each there is
    the `tangent`, the derivative by forward mode along a random direction, and `modes_error`, its
    relative difference from the adjoint's. `entries` are that direction and so many `samples` of
    the parameter's: the `adjoint`, the derivative by reverse mode, and the central `difference`
    with the `step` that agrees best, whose relative difference is `error`. A check has `passed`
    where both errors are within bounds, and the report where all have. Raises UsageError for a name
    the scene does not have.
    """
    known = variable_names(scene)
    if unknown := [name for name in names if name not in known]:
        fault = "the scene has no such number"
        raise UsageError([f"--parameter {n}: {fault}{suggestion(n, known)}" for n in unknown])
    optimized = scene.optimize.parameters if scene.optimize else density_names(scene)
    names, generator = tuple(dict.fromkeys(names or optimized)), torch.Generator().manual_seed(seed)
    point = starting_point(scene, names, generator)
    loss = loss_at(scene, point, generator)
    leaves = [point[name].clone().requires_grad_() for name in names]
    value = loss(dict(zip(names, leaves, strict=True)))
    bars = torch.autograd.grad(value, leaves, allow_unused=True, materialize_grads=True)
    values = {name: (point[name], bar) for name, bar in zip(names, bars, strict=True)}
    checks = [
        _check(name, loss, {name: values[name]}, samples, generator)
        for name in show_progress(names, "gradcheck")
    ]
    if len(names) > 1:
        checks.append(_check(TOGETHER, loss, values, 0, generator))
    return {"passed": all(check["passed"] for check in checks), "checks": checks}


def _check(
    label: str,
    loss: Loss,
    parameters: Mapping[str, tuple[Tensor, Tensor]],
    samples: int,
    generator: torch.Generator,
) -> dict[str, Any]:
    """The check, called `label`, of `parameters`, values with their gradients."""
    steps, direction, adjoint = dict[str, list[float]](), dict[str, Tensor](), 0.0
    for name, (value, bar) in parameters.items():
        size = float(value.abs().max()) or 1.0
        steps[name] = [step * size for step in kind_of(name).difference_steps]
        # The direction is as long as the longest steps: those along it are shares of 1.
        direction[name] = 2 * (random_like(value, generator) - 0.5) * steps[name][0]
        adjoint += float((bar * direction[name]).sum())

    def at(along: Values, step: float) -> float:
        moved = {name: parameters[name][0] + step * change for name, change in along.items()}
        with torch.no_grad():
            return float(loss(moved))

    first = next(iter(steps.values()))
    shares = [step / first[0] for step in first]
    along = {"entry": "a random direction", "value": None}
    entries = [along | _compare(functools.partial(at, direction), adjoint, shares, 0.0)]
    for name, (value, bar) in parameters.items() if samples else ():
        floor = NEGLIGIBLE * float(bar.abs().max())
        for index in pick_entries(name, value, samples, generator):
            unit = torch.zeros_like(value)
            unit.view(-1)[index] = 1
            slope, number = float(bar.flatten()[index]), float(value.flatten()[index])
            entry = {"entry": entry_name(name, value, index), "value": number}
            compared = _compare(functools.partial(at, {name: unit}), slope, steps[name], floor)
            entries.append(entry | compared)
    with forward_ad.dual_level():
        duals = {
            name: forward_ad.make_dual(parameters[name][0], change)
            for name, change in direction.items()
        }
        derivative = forward_ad.unpack_dual(loss(duals)).tangent
    tangent = 0.0 if derivative is None else float(derivative)
    error = abs(tangent - adjoint) / max(abs(adjoint), TINY)
    has_passed = error <= AGREE_MODES and all(e["error"] <= AGREE_DIFFERENCES for e in entries)
    check = {"parameter": label, "tangent": tangent, "modes_error": error}
    return check | {"entries": entries, "passed": has_passed}


def _compare(
    at: Callable[[float], float], adjoint: float, steps: Sequence[float], floor: float
) -> dict[str, Any]:
    """The central `difference` of `at` that agrees best, its `step` and its relative `error`.

    It is of fourth order: f' = (8 (f(h) - f(-h)) - (f(2h) - f(-2h))) / 12h. Each of the 18 values
    that this adds, counted by weight, may be off by one unit in the last place. Where none of
    `steps` agrees, three shorter ones follow, without that allowance: in thick cells, or beside an
    albedo of 1, all may be too long. Errors are relative to at least `floor`, and infinite where a
    difference is not a number.
    """
    tried = list[tuple[float, float, float]]()
    shorter = [steps[-1] / 10**power for power in (1, 2, 3)]
    for step in (*steps, *shorter):
        is_usual, difference, error = step in steps, math.nan, math.inf
        if tried and min(tried)[0] <= (CLOSE if is_usual else AGREE_DIFFERENCES):
            break
        # A step that leaves what is physical may have no solution.
        with contextlib.suppress(SolveError):
            ahead, back, far_ahead, far_back = (at(times * step) for times in (1, -1, 2, -2))
            difference = (8 * (ahead - back) - (far_ahead - far_back)) / (12 * step)
            largest = max(map(abs, (ahead, back, far_ahead, far_back)))
            rounding = is_usual * 18 * torch.finfo(torch.float64).eps * largest / (12 * step)
            scale = max(abs(difference), abs(adjoint), floor, rounding / AGREE_DIFFERENCES, TINY)
            error = abs(difference - adjoint) / scale
        tried.append((error if math.isfinite(error) else math.inf, step, difference))
    error, step, difference = min(tried)
    return {"adjoint": adjoint, "difference": difference, "step": step, "error": error}


def starting_point(
    scene: Scene, names: tuple[str, ...], generator: torch.Generator
) -> dict[str, Tensor]:
    """The value of each optimized parameter, of each of `names`, and of density.

    Density is the scene's own; where that is the same everywhere, what it starts from; where that
    is, too, random numbers of which half are empty: a volume without any hides all else. A single
    cell, which cannot vary, is not empty. What moves rays or beams is moved by a random share of
    the variable's rate: along the lattice rays meet centers of cells, where interpolation has a
    slope to each side, and differences a mean of both.
    """
    point = {
        name: scene.starts[name] if name in scene.starts else value_of(scene, name)
        for name in dict.fromkeys([*scene.starts, *names, *density_names(scene)])
    }
    if "density" in point and point["density"].ndim == 3:
        of_scene = scene.volume.density
        random = (2 * random_like(of_scene, generator) - 1).clamp(min=0)
        densities = (of_scene, point["density"], random)
        varied = (item for item in densities if bool((item != item.flatten()[0]).any()))
        point["density"] = next(varied, 1 - random)
    for name, value in point.items():
        kind = kind_of(name)
        if kind.difference_steps == SHORT_STEPS and not is_of_volume(name):
            step = kind.change(scene, name, value)
            point[name] = value + step * random_like(value, generator)
    return point


def loss_at(scene: Scene, point: Values, generator: torch.Generator) -> Loss:
    """The image loss of `scene` (float64), its own or `l2`, by parameters; others as in `point`.

    Targets are the images of the views that have them, else random ones.
    """
    exact = replace(scene, diffusion=replace(scene.diffusion, tolerance=1e-13))
    kind = (scene.optimize.loss if scene.optimize else None) or "l2"
    targets, memory = dict[str, Target](), SolveMemory(is_warm=False)
    for view in [view for view in scene.views if view.image is not None] or scene.views:
        image = view.image
        if image is None:
            image = random_like(scene.volume.density.new_empty(3, *view.camera.size), generator)
        targets[view.name] = Target.of(image, view.mask, kind)

    @functools.cache
    def light_at_point() -> LightField:
        return solve_light(with_values(exact, point), memory)

    def loss(values: Values) -> Tensor:
        changed = with_values(exact, {**point, **values})
        is_of_views = all(name.startswith("views.") for name in values)
        light = light_at_point() if is_of_views else solve_light(changed, memory)
        losses = [
            target.loss_of(view_picture(light, changed, changed.view(name)))
            for name, target in targets.items()
        ]
        return torch.stack(losses).mean()

    return loss


def pick_entries(name: str, value: Tensor, samples: int, generator: torch.Generator) -> list[int]:
    """Flat indices of `samples` random entries, of density half of them empty where enough are."""
    order = torch.randperm(value.numel(), generator=generator)
    if name != "density":
        return sorted(order[:samples].tolist())
    is_empty = value.flatten().cpu()[order] == 0
    empty = order[is_empty].tolist()[: samples // 2]
    return order[~is_empty].tolist()[: samples - len(empty)] + empty


def entry_name(name: str, value: Tensor, index: int) -> str:
    """What a user calls the entry at flat `index`: a component, cell (x, y, z) or pixel (x, y)."""
    # The last axis of a tensor is x, and its first, if there is such, is that of colors.
    place = [int(n) for n in reversed(torch.unravel_index(torch.tensor(index), value.shape))]
    components = component_names(name, value)
    color = f"{components[place.pop()]} " if components else ""
    if not components and value.ndim in (1, 4):
        place.pop()
    return f"{color}{tuple(place) if len(place) > 1 else ''}".strip() or "its value"


def random_like(like: Tensor, generator: torch.Generator) -> Tensor:
    """Uniform numbers in [0, 1) in the shape of `like`, the same whatever its type and device."""
    return torch.rand(like.shape, generator=generator, dtype=torch.float64).to(like)
