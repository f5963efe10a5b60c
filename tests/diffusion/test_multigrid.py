"""Multigrid's preconditioner is symmetric positive definite, and as fast on many cells."""

import math

import pytest
import torch
from media import dense_matrix, random_values, solve_by_gradients
from torch import Tensor

from ddrecon.diffusion.hierarchy import Hierarchy, Passes, prolong, restrict
from ddrecon.diffusion.hierarchy import matrix_of as matrix_of_cells
from ddrecon.diffusion.operator import AXES, Operator, boundary_loss, conductance
from ddrecon.diffusion.solve import solve_by_multigrid
from ddrecon.grid import Grid

SHAPES = [(1, 1, 1), (1, 1, 9), (1, 12, 17), (2, 3, 40), (7, 8, 9)]
FORMS = {
    "slab": ((1, 40, 40), (0.025, 1, 1)),
    "bar": ((120, 6, 6), (20, 1, 1)),
    "odd": ((19, 23, 17), (1, 1, 1)),
    "flat voxels": ((20, 20, 20), (1, 1, 10)),
    "long voxels": ((20, 20, 20), (1, 10, 10)),
    "bricks": ((20, 20, 20), (1, 2, 4)),
}


def uneven(
    shape: tuple[int, int, int], sides=(1, 1, 1), contrast: float = 1e3, dtype=torch.float64
) -> Operator:
    """Two colors: D that spans `contrast`, and D = 0.1; nothing absorbs but the box's faces."""
    grid = Grid(shape, tuple(-side / 2 for side in sides), tuple(side / 2 for side in sides))
    z, y, x = (torch.linspace(-1, 1, n + 2, dtype=torch.float64)[1:-1] for n in shape)
    ball = torch.exp(-4 * (z[:, None, None] ** 2 + (y[:, None] - 0.3) ** 2 + x**2))
    diffusion = (0.1 * torch.stack([contrast**-ball, torch.ones(shape)])).to(dtype)
    return operator_of(diffusion, grid)


def operator_of(diffusion: Tensor, grid: Grid) -> Operator:
    c_z, c_y, c_x = (conductance(diffusion, grid, axis) for axis in AXES)
    return Operator((c_z, c_y, c_x), boundary_loss(diffusion, grid), spacing=grid.spacing)


def patchy(patch: int, contrast: float, dtype: torch.dtype, cells: int = 16) -> Operator:
    """D random and the same within patches of so many cells a side."""
    patches = random_values(1, *(cells // patch,) * 3)
    diffusion = 0.1 * contrast**-patches
    for axis in AXES:
        diffusion = diffusion.repeat_interleave(patch, axis)
    return operator_of(diffusion.to(dtype), Grid((cells,) * 3, (-0.5,) * 3, (0.5,) * 3))


def cycle_of(operator: Operator):
    """The V-cycle as a function of [C, z, y, x]."""
    hierarchy = Hierarchy.of(operator, Passes())
    return lambda source: hierarchy.cycle(Passes(), source)


def matrix_of(cycle, shape: tuple[int, ...]) -> Tensor:
    """The matrix [C, n, n] of a linear function of [C, z, y, x]."""
    size = math.prod(shape[1:])
    units = torch.eye(size, dtype=torch.float64).view(-1, 1, *shape[1:])
    columns = [cycle(unit.repeat(shape[0], 1, 1, 1)).flatten(1) for unit in units]
    return torch.stack(columns, -1)


@pytest.mark.parametrize("shape", [*SHAPES, None], ids=str)
def test_a_cycle_is_symmetric_and_positive_definite(shape: tuple[int, int, int] | None):
    """Of smooth media, and of one whose cells differ at random."""
    operator = uneven(shape) if shape else patchy(1, 1e6, torch.float64, cells=8)
    matrix = matrix_of(cycle_of(operator), operator.loss.shape)
    assert float((matrix - matrix.mT).abs().max()) < 1e-13 * float(matrix.abs().max())
    assert float(torch.linalg.eigvalsh(matrix).min()) > 0


def test_a_cycle_in_single_precision_is_symmetric_to_rounding():
    operator = uneven((16, 24, 20), contrast=1e6, dtype=torch.float32)
    a, b = (random_values(2, 16, 24, 20, seed=seed, dtype=torch.float32) - 0.5 for seed in (1, 2))
    cycle = cycle_of(operator)
    there, back = (float((p.double() * cycle(q).double()).sum()) for p, q in ((a, b), (b, a)))
    assert abs(there - back) < 1e-5 * float(a.norm() * cycle(b).norm())


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("cells", [2, 5, 6])
@pytest.mark.parametrize("wraps", [False, True])
def test_interpolation_is_the_transpose_of_restriction_and_keeps_constants(
    axis: int, cells: int, wraps: bool
):
    shape = tuple(cells if a == axis else 3 for a in AXES)
    operator = patchy_box(shape, wraps)
    coarsening, coarse = Passes().coarsen(operator, axis)
    fine, u = random_values(2, *shape, seed=5), random_values(2, *coarse.loss.shape[1:], seed=6)
    one, other = (restrict(coarsening, fine) * u).sum(), (fine * prolong(coarsening, u)).sum()
    torch.testing.assert_close(one, other, rtol=1e-13, atol=0)
    assert torch.equal(prolong(coarsening, torch.ones_like(u)), torch.ones_like(fine))
    torch.testing.assert_close(coarse.loss.sum(), operator.loss.sum())


def patchy_box(shape: tuple[int, ...], wraps: bool = False) -> Operator:
    faces = [random_values(2, *shape, seed=axis) + 0.01 for axis in AXES]
    for axis, conductances in zip(AXES, faces, strict=True):
        if not wraps or shape[axis - 1] == 1:
            conductances.select(axis, -1).zero_()
    periodic = (0, 1, 2) if wraps else ()
    return Operator(tuple(faces), random_values(2, *shape, seed=9), periodic)


@pytest.mark.parametrize("shape", [(2, 3, 4), (7, 6, 5)])
def test_a_box_whose_ends_are_neighbors_is_solved(shape: tuple[int, ...]):
    operator = patchy_box(shape, wraps=True)
    u = random_values(2, *shape, seed=3)
    source = operator.apply(u)
    by_matrix = (dense_matrix(operator) @ u.flatten(1)[..., None]).view_as(u)
    torch.testing.assert_close(source, by_matrix, rtol=1e-13, atol=1e-13)
    matrix = matrix_of(cycle_of(operator), operator.loss.shape)
    assert float((matrix - matrix.mT).abs().max()) < 1e-13 * float(matrix.abs().max())
    solution = solve_by_multigrid(operator, source, None, 1e-13)
    torch.testing.assert_close(solution.value, u, rtol=1e-10, atol=1e-10)
    assert solution.iterations < 20


def test_few_cells_are_solved_directly():
    operator = patchy_box((3, 4, 5))
    source = random_values(2, 3, 4, 5, seed=7)
    exact = torch.linalg.solve(dense_matrix(operator), source.flatten(1)).view_as(source)
    matrix = matrix_of_cells(operator)
    torch.testing.assert_close(matrix, dense_matrix(operator))
    torch.testing.assert_close(Passes().solve(matrix.inverse(), source), exact)


def test_iterations_do_not_grow_with_the_number_of_cells():
    counts = [
        solve_by_multigrid(uneven((n, n, n)), random_values(2, n, n, n), None, 1e-6).iterations
        for n in (8, 16, 32)
    ]
    assert max(counts) <= counts[0] + 2 and max(counts) <= 15


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_boxes_and_cells_of_any_form_take_few_iterations(form: str, dtype: torch.dtype):
    shape, sides = FORMS[form]
    operator, source = uneven(shape, sides, dtype=dtype), random_values(2, *shape, dtype=dtype)
    assert solve_by_multigrid(operator, source, None, 1e-6).iterations <= 15


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_patches_of_a_million_to_one_take_few_iterations(dtype: torch.dtype):
    """Random in every cell they take more, but less than a third of conjugate gradients alone."""
    source = random_values(1, 16, 16, 16, dtype=dtype)
    assert solve_by_multigrid(patchy(4, 1e6, dtype), source, None, 1e-6).iterations <= 15
    operator = patchy(1, 1e6, dtype)
    few, (u, many) = (
        solve_by_multigrid(operator, source, None, 1e-6),
        solve_by_gradients(operator, source, 1e-6),
    )
    assert 3 * few.iterations < many
    torch.testing.assert_close(few.value, u, rtol=0, atol=1e-3 * float(u.max()))


def test_conductances_shared_by_colors_may_be_given_once():
    shape = (6, 9, 7)
    operator = uneven(shape)
    loss = operator.loss[:1] + torch.tensor([0.0, 1.0, 5.0]).view(-1, 1, 1, 1)
    shared = Operator(tuple(c[:1] for c in operator.conductances), loss)
    spread = Operator(tuple(c.expand(3, -1, -1, -1) for c in shared.conductances), shared.loss)
    source = random_values(3, *shape)
    one, other = (solve_by_multigrid(each, source, None, 1e-9).value for each in (shared, spread))
    torch.testing.assert_close(one, other)
