"""Flux-limited diffusion: its limiter, its fixed point, the derivatives of that, and failures."""

import itertools

import pytest
import torch
from media import assert_derivatives, box_grid, half_empty, make_scene, random_values
from torch import Tensor

from ddrecon.diffusion import flux_limited
from ddrecon.diffusion.flux_limited import (
    VACUUM,
    LimitedOperator,
    iterate_picard,
    limit_diffusion,
)
from ddrecon.diffusion.implicit import ImplicitSolve, SolveMemory, SolverWithMemory
from ddrecon.errors import SolveError
from ddrecon.grid import Grid
from ddrecon.lighting import solve_light
from ddrecon.picture import render
from ddrecon.scene import Scene
from ddrecon.variables.values import with_values

SHAPE = (3, 4, 3)


@pytest.fixture
def make():
    """A half-empty scene of three colors."""

    def scene(density: Tensor | None = None, **changes) -> Scene:
        density = half_empty(*SHAPE) if density is None else density
        lights = {"ambient": (0.3, 0.2, 0.1), "tolerance": 1e-12}
        return make_scene(density, **{"model": "flux_limited", "g": 0.4, **lights} | changes)

    return scene


def solved(
    grid: Grid, memory: SolveMemory, tolerance: float, source: Tensor, *tensors: Tensor
) -> Tensor:
    """The light of kappa_s Q0 = `source`, differentiable by that and by the operator's tensors."""
    solve = SolverWithMemory(iterate_picard, tolerance, memory)
    return ImplicitSolve.apply(
        solve, lambda _, *some: LimitedOperator(grid, tensors=some), {}, source, *tensors
    )


def test_diffusion_falls_where_light_does_cell_by_cell():
    grid, u = box_grid((3, 4, 2)), 1 + random_values(1, 3, 4, 2)
    extinction = 5 * random_values(1, 3, 4, 2, seed=1)
    square = 9 * (extinction[0] ** 2 + (VACUUM / min(grid.extent)) ** 2)
    for cell in itertools.product(*map(range, grid.shape)):
        for axis, h in enumerate(grid.spacing):
            # a neighbor beyond the box is replaced by the cell itself, and the step is shorter
            ends = [min(max(cell[axis] + side, 0), grid.shape[axis] - 1) for side in (-1, 1)]
            low, high = (u[0][(*cell[:axis], end, *cell[axis + 1 :])] for end in ends)
            square[cell] += 4 * ((high - low) / (h * (ends[1] - ends[0])) / u[0][cell]) ** 2
    found = limit_diffusion(u, extinction, grid)[0]
    torch.testing.assert_close(found, square**-0.5, rtol=1e-9, atol=0)


@pytest.mark.parametrize("value", [0.0, 2.0])
def test_even_light_and_no_light_diffuse_with_one_third_of_the_transport_length(value: float):
    u = torch.full((2, 3, 4, 2), value, dtype=torch.float64, requires_grad=True)
    found = limit_diffusion(u, torch.full_like(u, 1e4).detach(), box_grid((3, 4, 2)))
    (slope,) = torch.autograd.grad(found.sum(), u)
    assert not slope.any()
    torch.testing.assert_close(found, torch.full_like(u, 1 / 3e4), rtol=1e-9, atol=0)


def test_the_light_found_balances():
    grid = box_grid(SHAPE)
    source, *fields = [5 * random_values(2, *SHAPE, seed=seed) for seed in range(3)]
    outside = torch.tensor([0.5, 1.0], dtype=torch.float64).view(2, 1, 1, 1)
    u = solved(grid, SolveMemory(), 1e-13, source, *fields, outside)
    left = LimitedOperator(grid, tensors=(*fields, outside)).apply(u) - source
    assert float(left.abs().max()) < 1e-11 * float(u.abs().max())


def test_dense_media_diffuse_as_without_a_limit(make):
    """Uniform and 4000 optical depths thick: R is small, and so is what is added to the medium."""
    dense = torch.full(SHAPE, 500.0, dtype=torch.float64)
    ours, theirs = (
        solve_light(make(dense, directional=None, model=model), SolveMemory()).diffuse[0]
        for model in ("flux_limited", "p1")
    )
    torch.testing.assert_close(ours, theirs, rtol=0.03, atol=1e-6)


@pytest.mark.slow
def test_derivatives_agree_with_each_other_and_differences():
    shape, weights = (2, 3, 2), random_values(1, 2, 3, 2, seed=7)
    inputs = [4 * random_values(1, *shape, seed=seed) for seed in range(3)]
    inputs[1] *= random_values(1, *shape, seed=9) > 0.5
    flux = [random_values(1, *shape, seed=seed) for seed in (4, 5, 6)]
    arguments = [*inputs, torch.full((1, 1, 1, 1), 0.5, dtype=torch.float64), *flux]

    def total(values: dict[str, Tensor]) -> Tensor:
        memory = SolveMemory(is_warm=False)
        return (weights * solved(box_grid(shape), memory, 1e-14, *values.values())).sum()

    assert_derivatives(total, {str(k): value for k, value in enumerate(arguments)}, 1e-6)


@pytest.mark.parametrize(
    "lights", [{}, {"ambient": None}, {"ambient": None, "directional": None}], ids=str
)
def test_an_empty_box_has_finite_derivatives(lights: dict[str, None], make):
    density = torch.zeros(SHAPE, dtype=torch.float64, requires_grad=True)
    scene = with_values(make(density.detach(), **lights), {"density": density})
    (slope,) = torch.autograd.grad(render(scene).sum(), density)
    assert bool(slope.isfinite().all())


def test_iterations_are_recorded_and_resumed(make):
    scene, memory = make(), SolveMemory()
    for _ in range(2):
        render(scene, memory=memory)
    first, second = memory.records
    assert first.kind == second.kind == "forward" and first.iterations > 1 >= second.iterations
    assert first.residual <= 1e-12


def test_giving_up_says_what_may_help(make, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(flux_limited, "MAX_ITERATIONS", 3)
    told = r"flux-limited .*after 3 iterations .*diffusion\.model=p1"
    with pytest.raises(SolveError, match=told):
        render(make())
