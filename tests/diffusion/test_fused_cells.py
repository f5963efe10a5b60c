"""Fused kernels of D, system and flux compute what torch does: values and cotangents."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from graphics_cards import assert_compiles
from media import box_grid, half_empty, random_values
from torch import Tensor

from ddrecon.diffusion.conservative import DiffusionProblem
from ddrecon.engine import use_engine
from ddrecon.medium.coefficients import Medium, Volume, scale_medium

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from ddrecon.diffusion.fused import faces
from ddrecon.kernels.cell_function import RowFunction

pytestmark = pytest.mark.slow

Shape = tuple[int, int, int]
Found = tuple[list[Tensor], list[Tensor]]
SHAPES: list[Shape] = [(5, 7, 19), (1, 4, 3), (3, 1, 1)]
COLORS = [(1, 1), (1, 3), (3, 3)]
"""Of the medium and of the light."""
each_shape = pytest.mark.parametrize("shape", SHAPES, ids=str)
each_colors = pytest.mark.parametrize("colors", COLORS, ids=str)


def make_medium(
    shape: Shape,
    colors: int,
    *,
    has_fields: bool,
    dtype: torch.dtype,
    periodic: tuple[int, ...] = (),
) -> tuple[Medium, list[Tensor]]:
    """A medium, empty in parts, and its leaves: density and, last, cross sections and g."""
    cells = shape if has_fields else ()
    sigma_a, sigma_s = (random_values(colors, *cells, seed=s, dtype=dtype) for s in (7, 8))
    density = 5 * half_empty(*shape, dtype=dtype)
    leaves = [density, sigma_a, 6 * sigma_s, density.new_tensor(0.4)]
    for leaf in leaves:
        leaf.requires_grad_()
    grid = replace(box_grid(shape), periodic=periodic)
    return scale_medium(Volume(grid, *leaves)), leaves


def make_problem(
    medium: Medium, colors: int, is_directed: bool, dtype: torch.dtype
) -> tuple[DiffusionProblem, list[Tensor]]:
    """A problem in `medium` with a random source, and the leaves of that."""
    shape = medium.grid.shape
    count = 4 if is_directed else 1
    source = random_values(count, *shape, colors, seed=11, dtype=dtype).movedim(-1, 1)
    outside = random_values(colors, 1, 1, 1, seed=3, dtype=dtype)
    leaves = [outside, source]
    for leaf in leaves:
        leaf.requires_grad_()
    return DiffusionProblem(medium, lambda k: 1 / (3 * k + 0.5), source, outside, True), leaves


def bar_of(result: Tensor, seed: int) -> Tensor:
    """A random cotangent of `result`, as a view of what has its colors last."""
    colors = result.shape[-4]
    shape = *result.shape[:-4], *result.shape[-3:], colors
    return random_values(*shape, seed=seed).to(result).movedim(-1, -4)


def weigh(results: list[Tensor], leaves: list[Tensor]) -> Found:
    """`results`, and the cotangents of `leaves` for random cotangents of the results."""
    bars = [bar_of(r, 20 + i) for i, r in enumerate(results)]
    return results, list(torch.autograd.grad(results, leaves, bars))


def problem_of(
    engine: str,
    shape: Shape,
    colors: tuple[int, int],
    kind: tuple[bool, bool],
    dtype: torch.dtype,
    periodic: tuple[int, ...] = (),
) -> Found:
    """System and flux, with the derivatives by density, sections, g, Q0, Q1, outside and L0."""
    use_engine(engine)
    medium, leaves = make_medium(
        shape, colors[0], has_fields=kind[0], dtype=dtype, periodic=periodic
    )
    problem, more = make_problem(medium, colors[1], kind[1], dtype)
    operator, right = problem.system
    mean = random_values(*right.shape, seed=5, dtype=dtype).requires_grad_()
    flux = problem.flux(mean)
    assert flux is not None
    off = problem.flux(mean, more=flux.roll(1, 0), before=flux.roll(2, 0))
    assert off is not None
    side = problem.right_side(mean, flux)
    results = [*operator.conductances, operator.loss, right, flux, off, side]
    return weigh(results, [*leaves, *more, mean])


def assert_equal(find: Callable[[str], Found], error: float) -> None:
    (known, known_bars), (found, found_bars) = find("torch"), find("warp")
    for one, other in zip([*found, *found_bars], [*known, *known_bars], strict=True):
        # Sums over cells cancel in part.
        size = max(float(other.detach().norm()), 1e-2) * (1 if one.ndim > 1 else 10)
        torch.testing.assert_close(one, other, rtol=0, atol=error * size)


@each_shape
@each_colors
@pytest.mark.parametrize("has_fields", [False, True])
@pytest.mark.parametrize("is_directed", [False, True])
def test_systems_and_fluxes_agree(
    shape: Shape, colors: tuple[int, int], has_fields: bool, is_directed: bool
):
    kind = has_fields, is_directed
    assert_equal(lambda e: problem_of(e, shape, colors, kind, torch.float64), 1e-12)
    if colors == COLORS[-1] and kind == (False, True):
        assert_equal(lambda e: problem_of(e, shape, colors, kind, torch.float32), 1e-5)


@pytest.mark.parametrize(("shape", "periodic"), [((5, 4, 9), (0, 2)), ((3, 4, 1), (1, 2))])
def test_around_a_period_they_agree(shape: Shape, periodic: tuple[int, ...]):
    kind = False, True
    assert_equal(lambda e: problem_of(e, shape, (1, 3), kind, torch.float64, periodic), 1e-12)


def test_kernels_compile_for_graphics_cards(tmp_path: Path):
    place = 1, faces.PLACE, faces.GIVEN
    system = RowFunction(faces.HEADER, "Flow<SYSTEM, 1, 0>", ((),) * 5, *place)
    flux = RowFunction(faces.HEADER, "Flow<FLUX, 1, 3>", ((3, 1, 1, 1, 1),), *place)
    assert_compiles([system.kernel("tangents", 7, 32), flux.kernel("values", 9, 64)], tmp_path)
