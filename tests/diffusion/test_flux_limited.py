"""Flux-limited diffusion: its limiters, its fixed point, the derivatives of that, and failures."""

import itertools

import pytest
import torch
from media import box_grid, half_empty, make_scene, random_values
from torch import Tensor

from ddrecon.diffusion import flux_limited
from ddrecon.diffusion.flux_limited import LIMITERS, SERIES_BELOW, Balance, steepness_square
from ddrecon.diffusion.implicit import SolveMemory, SolverWithMemory
from ddrecon.diffusion.solvers.multigrid import solve_by_multigrid
from ddrecon.errors import SolveError
from ddrecon.renderer import render, solve_light
from ddrecon.scene import Scene
from ddrecon.variables.values import with_values

each_limiter = pytest.mark.parametrize("limiter", LIMITERS)
SHAPE = (3, 4, 3)


@pytest.fixture
def make():
    """A half-empty scene of three colors."""

    def scene(density: Tensor | None = None, **changes) -> Scene:
        density = half_empty(*SHAPE) if density is None else density
        lights = {"ambient": (0.3, 0.2, 0.1), "tolerance": 1e-12}
        return make_scene(density, **{"model": "flux_limited", "g": 0.4, **lights} | changes)

    return scene


def make_solve(tolerance: float, memory: SolveMemory | None = None) -> SolverWithMemory:
    return SolverWithMemory(solve_by_multigrid, tolerance, memory or SolveMemory())


def test_steepness_is_that_of_central_differences_cell_by_cell():
    grid, u = box_grid((3, 4, 2)), 1 + random_values(1, 3, 4, 2)
    expected = torch.zeros_like(u[0])
    for cell in itertools.product(*map(range, grid.shape)):
        for axis, h in enumerate(grid.spacing):
            # a neighbor beyond the box is replaced by the cell itself, and the step is shorter
            ends = [min(max(cell[axis] + side, 0), grid.shape[axis] - 1) for side in (-1, 1)]
            low, high = (u[0][(*cell[:axis], end, *cell[axis + 1 :])] for end in ends)
            expected[cell] += ((high - low) / (h * (ends[1] - ends[0])) / u[0][cell]) ** 2
    torch.testing.assert_close(steepness_square(u, grid)[0], expected, rtol=1e-9, atol=0)


def test_even_light_and_no_light_have_no_steepness():
    for value in (0.0, 2.0):
        u = torch.full((2, 3, 4, 2), value, dtype=torch.float64, requires_grad=True)
        q = steepness_square(u, box_grid((3, 4, 2)))
        (slope,) = torch.autograd.grad(q.sum(), u)
        assert bool((q == 0).all()) and bool((slope == 0).all())


@each_limiter
def test_the_light_found_balances(limiter: str, make):
    balance = Balance(box_grid(SHAPE), LIMITERS[limiter])
    fields = [5 * random_values(2, *SHAPE, seed=seed) for seed in range(3)]
    outside = torch.tensor([0.5, 1.0], dtype=torch.float64).view(2, 1, 1, 1)
    u = flux_limited.ImplicitFixedPoint.apply(make_solve(1e-13), balance, *fields, outside)
    assert float(balance.residual(u, *fields, outside).abs().max()) < 1e-11 * float(u.abs().max())


@each_limiter
def test_dense_media_diffuse_as_without_a_limit(limiter: str, make):
    """Uniform and 4000 optical depths thick: R is small, and so is what is added to the medium."""
    dense = torch.full(SHAPE, 500.0, dtype=torch.float64)
    ways = {"limiter": limiter}, {"model": "p1"}
    ours, theirs = (
        solve_light(make(dense, directional=None, **way), SolveMemory()).diffuse.mean
        for way in ways
    )
    torch.testing.assert_close(ours, theirs, rtol=0.03, atol=1e-6)


@each_limiter
def test_both_derivatives_agree_with_differences(limiter: str):
    shape = (2, 3, 2)
    inputs = [4 * random_values(1, *shape, seed=seed) for seed in range(3)]
    inputs[0] *= random_values(1, *shape, seed=9) > 0.5
    flux = [random_values(1, *shape, seed=seed) for seed in (4, 5, 6)]
    arguments = [*inputs, torch.full((1, 1, 1, 1), 0.5, dtype=torch.float64), *flux]
    sizes = [argument.numel() for argument in arguments]
    balance = Balance(box_grid(shape), LIMITERS[limiter])

    def solved(together: Tensor) -> Tensor:
        parts = zip(together.split(sizes), arguments, strict=True)
        coefficients = [part.view(argument.shape) for part, argument in parts]
        solve = make_solve(1e-14, SolveMemory(is_warm=False))
        return flux_limited.ImplicitFixedPoint.apply(solve, balance, *coefficients)

    # Along a direction in which all vary: each solve takes some sixty steps.
    together = torch.cat([argument.flatten() for argument in arguments]).requires_grad_()
    assert torch.autograd.gradcheck(
        solved, together, eps=1e-5, atol=1e-8, rtol=1e-6, check_forward_ad=True, fast_mode=True
    )


@each_limiter
@pytest.mark.parametrize(
    "lights", [{}, {"ambient": None}, {"ambient": None, "directional": None}], ids=str
)
def test_an_empty_box_has_finite_derivatives(limiter: str, lights: dict[str, None], make):
    density = torch.zeros(SHAPE, dtype=torch.float64, requires_grad=True)
    scene = with_values(make(density.detach(), limiter=limiter, **lights), {"density": density})
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


each_formula = pytest.mark.parametrize("limiter", LIMITERS.values(), ids=LIMITERS.keys())
STREAMING = {"marshak": 0.5, "levermore_pomraning": 1.0}
"""The flux in units of L0 where nothing collides."""


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


@each_formula
def test_even_light_diffuses_with_one_third_of_the_transport_length(limiter):
    assert float(limiter(number(7.0), number(0.0))) == pytest.approx(1 / 21, rel=1e-15)
    assert float(limiter(number(7.0), number(1e-6))) == pytest.approx(1 / 21, rel=1e-7)


@pytest.mark.parametrize("name", LIMITERS)
def test_light_in_empty_space_flows_no_faster_than_it_may(name: str):
    steepness = 5.0
    flux = steepness * float(LIMITERS[name](number(1e-9), number(steepness**2)))
    assert flux == pytest.approx(STREAMING[name], rel=1e-6)


@each_formula
def test_flux_never_exceeds_radiance(limiter):
    extinction = torch.logspace(-6, 6, 61, dtype=torch.float64)
    steepness = torch.logspace(-6, 6, 49, dtype=torch.float64)[:, None]
    assert bool((steepness * limiter(extinction, steepness**2) < 1).all())


@each_formula
@pytest.mark.parametrize("square", [0.0, 1e-8, SERIES_BELOW, 1.0, 1e6])
def test_derivatives(limiter, square: float):
    arguments = (number(0.7).requires_grad_(), number(0.49 * square + 1e-3).requires_grad_())
    assert torch.autograd.gradcheck(limiter, arguments, eps=1e-7, atol=1e-8, check_forward_ad=True)
    slopes = torch.autograd.grad(limiter(arguments[0], arguments[1] * 0), arguments)
    assert all(bool(slope.isfinite()) for slope in slopes)


def test_the_series_meets_the_closed_form():
    below, above = (
        LIMITERS["levermore_pomraning"](number(1.0), number(SERIES_BELOW * factor))
        for factor in (1 - 1e-12, 1 + 1e-12)
    )
    assert float((below - above).abs()) < 1e-12
