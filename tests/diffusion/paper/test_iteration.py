"""Algorithm 3 on the printed scheme: where it stops, and what it says where it diverges."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from media import box_grid, make_scene, random_values
from printed_media import make_printed, smooth_scene
from torch import Tensor
from torch.autograd import forward_ad

from ddrecon.diffusion.closures import CLOSURES, FLOOR
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.diffusion.paper import iteration
from ddrecon.diffusion.paper.iteration import iterate_jacobi
from ddrecon.diffusion.paper.operator import PrintedOperator
from ddrecon.errors import SolveError
from ddrecon.grid import Grid
from ddrecon.medium.coefficients import keep_medium
from ddrecon.renderer import render, solve_light
from ddrecon.scene import Scene


def exact(operator: PrintedOperator, source: Tensor) -> Tensor:
    shape = operator.stencils.grid.shape
    columns = (
        torch.eye(math.prod(shape), dtype=torch.float64)
        .view(-1, 1, *shape)
        .expand(-1, source.shape[0], -1, -1, -1)
    )
    matrix = torch.stack([operator.apply(column).flatten(1) for column in columns], 2)
    return torch.linalg.solve(matrix, source.flatten(1)).view_as(source)


@pytest.mark.parametrize("is_transposed", [False, True])
@pytest.mark.parametrize("tolerance", [1e-3, 1e-8, 1e-13])
def test_the_tolerance_is_a_relative_residual(tolerance: float, is_transposed: bool):
    operator = replace(make_printed(box_grid((4, 5, 3))), is_transposed=is_transposed)
    source = random_values(2, 4, 5, 3, seed=3) - 0.5
    solution = iterate_jacobi(operator, source, None, tolerance)
    residual = (source - operator.apply(solution.value)) / operator.diagonal
    assert 0 < solution.residual <= tolerance
    assert float(residual.norm() / (source / operator.diagonal).norm()) < 2 * tolerance
    torch.testing.assert_close(
        solution.value, exact(operator, source), rtol=1e3 * tolerance, atol=1e2 * tolerance
    )


def test_a_tolerance_below_rounding_ends_all_the_same():
    operator, source = make_printed(box_grid((4, 5, 3))), random_values(2, 4, 5, 3, seed=3)
    solution = iterate_jacobi(operator, source, None, 1e-30)
    torch.testing.assert_close(solution.value, exact(operator, source), rtol=1e-12, atol=0)


@pytest.mark.parametrize("has_guess", [False, True])
def test_a_color_without_source_stays_dark(has_guess: bool):
    operator, source = make_printed(box_grid((4, 5, 3))), random_values(2, 4, 5, 3, seed=3)
    source[0] = 0
    value = iterate_jacobi(
        operator, source, random_values(2, 4, 5, 3) if has_guess else None, 1e-8
    ).value
    assert not value[0].any() and bool(value[1].any())


def test_a_random_start_is_the_same_in_every_run():
    first, second = (SolveMemory(is_warm=False) for _ in range(2))
    assert torch.equal(render(smooth_scene(), memory=first), render(smooth_scene(), memory=second))
    torch.manual_seed(5)
    render(smooth_scene(), memory=first)
    assert (
        first.records[0].iterations == first.records[1].iterations == second.records[0].iterations
    )


def test_a_warm_start_takes_fewer_iterations():
    """All three kinds are recorded; tangents, which have nothing in common, start anew."""
    scene, memory = smooth_scene(tolerance=1e-6), SolveMemory()
    for step in (0.0, 1e-3):
        density = (scene.volume.density * (1 + step)).requires_grad_()
        moved = replace(scene, volume=replace(scene.volume, density=density))
        render(moved, memory=memory).sum().backward()
    with forward_ad.dual_level():
        density = forward_ad.make_dual(scene.volume.density, scene.volume.density)
        render(replace(scene, volume=replace(scene.volume, density=density)), memory=memory)
    assert [record.kind for record in memory.records] == ["forward", "adjoint"] * 2 + [
        "forward",
        "tangent",
    ]
    cold, warm = memory.records[:2], memory.records[2:4]
    assert all(b.iterations < 0.7 * a.iterations for a, b in zip(cold, warm, strict=True))


@pytest.fixture
def ball() -> Callable[..., Scene]:
    """A ball 0.7 `sigma` optical depths thick in empty space, its surface `width` cells wide."""

    def make(sigma: float, width: float, floor: float = FLOOR) -> Scene:
        grid = Grid((16, 16, 16), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
        radius = sum(axis**2 for axis in grid.centers(torch.zeros(1, dtype=torch.float64))).sqrt()
        density = (16 * (0.35 - radius) / width + 0.5).clamp(0, 1)
        optics = {"sigma_a": (0.01 * sigma,), "sigma_s": (0.99 * sigma,)}
        return make_scene(
            density, grid=grid, **optics, scheme="printed", tolerance=1e-4, floor=floor
        )

    return make


def kappa_of(scene: Scene) -> Tensor:
    return (
        3
        * CLOSURES["smooth"](
            keep_medium(scene.volume).transport_extinction, scene.volume.grid, scene.diffusion.floor
        )[0]
    )


def test_a_soft_ball_in_empty_space_diverges_and_names_the_cell(ball):
    """At a floor of 0.1; the cell named is the one whose neighbors differ most, by more than 4 of
    its own kappa.
    """
    scene = ball(20.0, 2.0, floor=0.1)
    with pytest.raises(SolveError, match=r"and above 4 .*diffusion\.scheme=conservative") as caught:
        solve_light(scene, SolveMemory())
    told = re.match(
        r"kappa changes by a factor ([\d.]+) between neighbors at cell \((\d+), (\d+), (\d+)\)",
        str(caught.value),
    )
    assert told is not None
    factor, (x, y, z) = float(told[1]), (int(index) for index in told.groups()[1:])
    kappa = torch.nn.functional.pad(kappa_of(scene)[None], (1,) * 6, mode="replicate")[0]
    beside = [
        (kappa[z + 2, y + 1, x + 1], kappa[z, y + 1, x + 1]),
        (kappa[z + 1, y + 2, x + 1], kappa[z + 1, y, x + 1]),
    ]
    beside += [(kappa[z + 1, y + 1, x + 2], kappa[z + 1, y + 1, x])]
    ratio = max(float((a - b).abs() / kappa[z + 1, y + 1, x + 1]) for a, b in beside)
    assert factor > 4 and factor == pytest.approx(ratio, abs=0.06)
    assert caught.value.iterations < 200 and caught.value.exit_code == 4


def test_divergence_that_the_criterion_does_not_explain_is_not_blamed_on_it():
    operator = make_printed(box_grid((4, 5, 3)))
    with pytest.raises(SolveError, match=r"diverged, although kappa changes by a factor [0-3]\."):
        iterate_jacobi(
            replace(operator, diagonal=operator.diagonal / 3), random_values(2, 4, 5, 3), None, 1e-8
        )


def test_slow_convergence_ends_with_an_error(monkeypatch):
    monkeypatch.setattr(iteration, "MAX_ITERATIONS", 4)
    with pytest.raises(SolveError, match="did not reach its tolerance after 4 iterations"):
        iterate_jacobi(make_printed(box_grid((4, 5, 3))), random_values(2, 4, 5, 3), None, 1e-8)


@pytest.mark.parametrize("where", ["source", "diagonal", "coefficients"])
def test_a_system_that_is_not_finite_is_an_error(where: str):
    operator, source = make_printed(box_grid((4, 5, 3))), random_values(2, 4, 5, 3)
    {"source": source, "diagonal": operator.diagonal, "coefficients": operator.coefficients}[where][
        0, 0, 0, 0
    ] = float("nan")
    with pytest.raises(SolveError, match="not finite"):
        iterate_jacobi(operator, source, None, 1e-8)
