"""The paper's own scheme, and flux-limited diffusion: twins, order, derivatives, failures."""

import itertools
import math
import re

import pytest
import torch
from media import (
    assert_image_derivatives,
    box_grid,
    convergence_order,
    half_empty,
    make_scene,
    random_values,
)
from test_operator import EXTENT, manufactured

from ddrecon.diffusion import closures, paper
from ddrecon.diffusion.implicit import ImplicitSolve, SolveMemory, SolverWithMemory
from ddrecon.diffusion.paper import (
    VACUUM,
    LimitedOperator,
    PrintedOperator,
    convolve,
    extend,
    fill_ghosts,
    iterate_jacobi,
    iterate_picard,
    limit_diffusion,
    make_stencils,
)
from ddrecon.errors import SolveError
from ddrecon.grid import Grid
from ddrecon.light.moments import flux_along_axes, moments_of_flux
from ddrecon.lighting import solve_light
from ddrecon.medium.coefficients import Volume, keep_medium
from ddrecon.picture import render
from ddrecon.variables.values import with_values

DARK = torch.zeros(1, 1, 1, 1, dtype=torch.float64)
SHAPES = [(3, 2, 4), (1, 2, 3), (1, 1, 1)]


def make_printed(grid, contrast=2.0, colors=2):
    """The operator of a medium whose kappa varies by `contrast` from cell to cell, at random."""
    kappa = 0.1 * contrast ** random_values(colors, *grid.shape, seed=1)
    stencils, squares = make_stencils(grid, kappa), sum(2 / h**2 for h in grid.spacing)
    diagonal = 3 * random_values(colors, *grid.shape, seed=2) + kappa * squares
    echo, _ = fill_ghosts(grid, kappa, None, DARK)
    weights = torch.cat([kappa[:, None], convolve(extend(kappa), stencils[1:])], 1)
    return PrintedOperator(grid, stencils, tensors=(diagonal, weights, echo))


def transposed(operator):
    return operator.linearized(torch.zeros_like(operator.tensors[0])).transposed()


def matrix_by_loops(operator, kappa, loss):
    """Eq. 22-24 with indices, `[n, n]` for the first color: a slow twin of the operator."""
    grid, shape = operator.grid, operator.grid.shape
    number = {cell: n for n, cell in enumerate(itertools.product(*map(range, shape)))}
    matrix = torch.zeros(len(number), len(number), dtype=kappa.dtype)
    for cell, row in number.items():
        matrix[row, row] += loss[cell]
        for axis, h in enumerate(grid.spacing):
            beside = [(*cell[:axis], cell[axis] + side, *cell[axis + 1 :]) for side in (-1, 1)]
            low, high = (kappa[other] if other in number else kappa[cell] for other in beside)
            for other, sign in zip(beside, (-1, 1), strict=True):
                weight = (kappa[cell] + sign * (high - low) / 4) / h**2
                matrix[row, row] += kappa[cell] / h**2
                echo = (4 * kappa[cell] - 3 * h) / (4 * kappa[cell] + 3 * h)
                matrix[row, number.get(other, row)] -= weight * (1 if other in number else echo)
    return matrix


def matrix_of(operator):
    """The matrix `[C, n, n]` of `operator`, column by column."""
    shape = operator.tensors[0].shape
    columns = torch.eye(math.prod(shape[1:]), dtype=torch.float64).view(-1, 1, *shape[1:])
    return torch.stack([operator.apply(one.expand(shape)).flatten(1) for one in columns], 2)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_the_operator_is_the_matrix_written_with_loops(shape):
    operator = make_printed(box_grid(shape), contrast=30.0)
    kappa = 0.1 * 30.0 ** random_values(2, *shape, seed=1)[0]
    expected = matrix_by_loops(operator, kappa, 3 * random_values(2, *shape, seed=2)[0])
    torch.testing.assert_close(matrix_of(operator)[0], expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(
        matrix_of(transposed(operator))[0], expected.T, rtol=1e-12, atol=1e-12
    )


def test_ghost_cells_hold_the_marshak_condition():
    """On every face: D (-grad L0 + kappa_s Q1) . n = (L0 - outside) / 2, by both sides' values."""
    grid = box_grid((3, 2, 4))
    outside = torch.tensor([0.7, 0.2], dtype=torch.float64).view(2, 1, 1, 1)
    kappa, u, *flux = (random_values(2, *grid.shape, seed=seed) for seed in range(5))
    echo, inflow = fill_ghosts(grid, kappa, tuple(flux), outside)
    around = echo * extend(u) + inflow
    assert torch.equal(around[:, 1:-1, 1:-1, 1:-1], u)
    for axis, h in enumerate(grid.spacing):
        ghost_cells, cells, k, q = (
            field.movedim(axis + 1, 0) for field in (around, u, kappa, flux[axis])
        )
        for end, sign in ((0, -1), (-1, 1)):
            ghost = ghost_cells[end][:, 1:-1, 1:-1]
            flow = k[end] / 3 * (-(ghost - cells[end]) / h + sign * q[end])
            leaves = ((ghost + cells[end]) / 2 - outside[..., 0]) / 2
            torch.testing.assert_close(flow, leaves, rtol=1e-12, atol=1e-12)


def errors_on(cells):
    """Relative RMS errors of L0 and L1 on a grid of `cells` along z."""
    grid = Grid((cells, cells, cells // 2), (0.0, 0.0, 0.0), EXTENT)
    places = torch.broadcast_tensors(*grid.centers(DARK))
    u, diffusion, absorption, mean, *vectors = manufactured(places)
    nothing, density = u.new_zeros(1), torch.ones_like(u[0])
    medium = keep_medium(Volume(grid, density, absorption, nothing, nothing[0]))
    solve = SolverWithMemory(iterate_jacobi, 1e-9, SolveMemory())
    scattered = torch.cat([mean[None], moments_of_flux(vectors[:3])])
    light = paper.solve_printed(medium, diffusion, scattered, DARK, solve, True)
    flux, expected = torch.stack(flux_along_axes(light[1:])), torch.stack(vectors[3:])
    errors = (light[0] - u).norm() / u.norm(), (flux - expected).norm() / expected.norm()
    return float(errors[0]), float(errors[1])


def test_a_manufactured_solution_is_approached_at_second_order():
    counts = [10, 14, 20]
    means, fluxes = zip(*(errors_on(cells) for cells in counts), strict=True)
    assert convergence_order([1 / cells for cells in counts], means) >= 1.75, means
    assert convergence_order([1 / cells for cells in counts], fluxes) >= 1.4, fluxes


def test_derivatives_of_an_image_agree_with_each_other_and_differences():
    settings = {"ambient": (0.3,), "scheme": "printed", "tolerance": 1e-14}
    scene = make_scene(1 + 0.5 * random_values(2, 2, 3), g=0.3, **settings)
    names = "density", "sigma_s", "g", "lights.0.irradiance"
    assert_image_derivatives(scene, names)


@pytest.fixture
def ball():
    """A ball 0.7 `sigma` optical depths thick in empty space, its surface `width` cells wide."""

    def make(sigma, width):
        grid = Grid((16, 16, 16), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
        radius = sum(axis**2 for axis in grid.centers(torch.zeros(1, dtype=torch.float64))).sqrt()
        density = (16 * (0.35 - radius) / width + 0.5).clamp(0, 1)
        optics = {"sigma_a": (0.01 * sigma,), "sigma_s": (0.99 * sigma,), "scheme": "printed"}
        return make_scene(density, grid=grid, **optics, tolerance=1e-4)

    return make


def test_a_soft_ball_in_empty_space_diverges_and_names_the_cell(ball, monkeypatch):
    """At a floor of 0.1; the cell named differs from its neighbors by over 4 of its kappa."""
    monkeypatch.setattr(closures, "FLOOR", 0.1)
    scene = ball(20.0, 2.0)
    with pytest.raises(SolveError, match=r"above 4; .*diffusion\.scheme=conservative") as caught:
        solve_light(scene, SolveMemory())
    words = r"the largest is ([\d.]+) at cell \((\d+), (\d+), (\d+)\)"
    told = re.search(words, str(caught.value))
    assert told is not None
    x, y, z = (int(index) for index in told.groups()[1:])
    here = scene.volume.density[z - 1 : z + 2, y - 1 : y + 2, x - 1 : x + 2]
    assert float(told[1]) > 4 and float(here.max()) > 4 * float(here.min())
    assert caught.value.iterations < 200 and caught.value.exit_code == 4


SHAPE = (3, 4, 3)


@pytest.fixture
def make():
    """A half-empty scene of three colors."""

    def scene(density=None, **changes):
        density = half_empty(*SHAPE) if density is None else density
        lights = {"ambient": (0.3, 0.2, 0.1), "tolerance": 1e-12}
        return make_scene(density, **{"model": "flux_limited", "g": 0.4, **lights} | changes)

    return scene


def solved(grid, memory, tolerance, source, *tensors):
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
    limited = limit_diffusion(u, extinction, grid)[0]
    torch.testing.assert_close(limited, square**-0.5, rtol=1e-9, atol=0)


def test_the_light_found_balances_and_is_found_again_at_once():
    grid = box_grid(SHAPE)
    source, *fields = [5 * random_values(2, *SHAPE, seed=seed) for seed in range(3)]
    outside = torch.tensor([0.5, 1.0], dtype=torch.float64).view(2, 1, 1, 1)
    memory = SolveMemory()
    u, _ = (solved(grid, memory, 1e-13, source, *fields, outside) for _ in range(2))
    assert memory.records[0].iterations > 1 >= memory.records[1].iterations
    residual = LimitedOperator(grid, tensors=(*fields, outside)).apply(u) - source
    assert float(residual.abs().max()) < 1e-11 * float(u.abs().max())


def test_dense_media_diffuse_as_without_a_limit(make):
    """Uniform and 4000 optical depths thick: R is small, and so is what is added to the medium."""
    dense = torch.full(SHAPE, 500.0, dtype=torch.float64)
    ours, theirs = (
        solve_light(make(dense, directional=None, model=model), SolveMemory()).diffuse[0]
        for model in ("flux_limited", "p1")
    )
    torch.testing.assert_close(ours, theirs, rtol=0.03, atol=1e-6)


@pytest.mark.parametrize(
    "lights", [{}, {"ambient": None}, {"ambient": None, "directional": None}], ids=str
)
def test_an_empty_box_has_finite_derivatives(lights, make):
    density = torch.zeros(SHAPE, dtype=torch.float64, requires_grad=True)
    scene = with_values(make(density.detach(), **lights), {"density": density})
    (slope,) = torch.autograd.grad(render(scene).sum(), density)
    assert bool(slope.isfinite().all())


def test_giving_up_says_what_may_help(make, monkeypatch):
    monkeypatch.setattr(paper, "PICARD_ITERATIONS", 3)
    words = r"flux-limited .*after 3 iterations .*diffusion\.model=p1"
    with pytest.raises(SolveError, match=words):
        render(make())
