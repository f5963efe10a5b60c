"""Solves: a preconditioner that is symmetric, few iterations, exact derivatives, memory."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from media import dense_matrix, random_values, solve_by_gradients
from torch.autograd import forward_ad

from ddrecon.diffusion import hierarchy, solve
from ddrecon.diffusion.hierarchy import Hierarchy, Passes, matrix_of, prolong, restrict
from ddrecon.diffusion.implicit import SolveMemory, SolverWithMemory, solve_diffusion
from ddrecon.diffusion.operator import AXES, Operator, boundary_loss, conductance
from ddrecon.diffusion.solve import solve_by_multigrid
from ddrecon.errors import SolveError
from ddrecon.grid import Grid

SHAPES = [(1, 1, 1), (1, 1, 9), (1, 12, 17), (2, 3, 40), (7, 8, 9)]
FORMS = {
    "slab": ((1, 40, 40), (0.025, 1, 1)),
    "bar": ((120, 6, 6), (20, 1, 1)),
    "odd": ((19, 23, 17), (1, 1, 1)),
    "flat voxels": ((20, 20, 20), (1, 1, 10)),
    "long voxels": ((20, 20, 20), (1, 10, 10)),
    "bricks": ((20, 20, 20), (1, 2, 4)),
    "cubes": ((32, 32, 32), (1, 1, 1)),
}
TOLERANCES = {torch.float32: 1e-5, torch.float64: 1e-11}
each_dtype = pytest.mark.parametrize("dtype", TOLERANCES, ids=str)


def operator_of(diffusion, grid):
    """Nothing absorbs but the box's faces."""
    z, y, x = (conductance(diffusion, grid, axis) for axis in AXES)
    return Operator((z, y, x), boundary_loss(diffusion, grid), spacing=grid.spacing)


def uneven(shape, sides=(1, 1, 1), dtype=torch.float64):
    """Two colors: D that spans a factor of 1000, and D = 0.1."""
    grid = Grid(shape, tuple(-side / 2 for side in sides), tuple(side / 2 for side in sides))
    z, y, x = (torch.linspace(-1, 1, n + 2, dtype=torch.float64)[1:-1] for n in shape)
    ball = torch.exp(-4 * (z[:, None, None] ** 2 + (y[:, None] - 0.3) ** 2 + x**2))
    return operator_of((0.1 * torch.stack([1e3**-ball, torch.ones(shape)])).to(dtype), grid)


def patchy(patch, dtype, cells=16):
    """D that spans a million, random and the same within patches of so many cells a side."""
    diffusion = 0.1 * 1e6 ** -random_values(1, *(cells // patch,) * 3)
    for axis in AXES:
        diffusion = diffusion.repeat_interleave(patch, axis)
    return operator_of(diffusion.to(dtype), Grid((cells,) * 3, (-0.5,) * 3, (0.5,) * 3))


def patchy_box(shape, wraps=False, colors=2):
    """Random conductances; those on the box conduct between its ends if it `wraps`."""
    faces = [random_values(colors, *shape, seed=axis) + 0.01 for axis in AXES]
    for axis, conductances in zip(AXES, faces, strict=True):
        if not wraps or shape[axis - 1] == 1:
            conductances.select(axis, -1).zero_()
    periodic = (0, 1, 2) if wraps else ()
    return Operator(tuple(faces), random_values(colors, *shape, seed=9), periodic)


def in_double(operator):
    return Operator(tuple(c.double() for c in operator.conductances), operator.loss.double())


# --- the V-cycle ---


def cycle_matrix(operator):
    """The matrix [C, n, n] of a V-cycle, column by column."""
    hierarchy, shape = Hierarchy.of(operator, Passes()), operator.loss.shape
    units = torch.eye(math.prod(shape[1:]), dtype=torch.float64).view(-1, 1, *shape[1:])
    columns = [hierarchy.cycle(Passes(), unit.repeat(shape[0], 1, 1, 1)) for unit in units]
    return torch.stack([column.flatten(1) for column in columns], -1)


CYCLES: list[tuple[str, Callable[[], Operator]]] = [
    *((str(shape), lambda shape=shape: uneven(shape)) for shape in SHAPES),
    ("random", lambda: patchy(1, torch.float64, cells=8)),
    ("around", lambda: patchy_box((7, 6, 5), wraps=True)),
]


@pytest.mark.parametrize("make", [make for _, make in CYCLES], ids=[name for name, _ in CYCLES])
def test_a_cycle_is_symmetric_and_positive_definite(make):
    matrix = cycle_matrix(make())
    assert float((matrix - matrix.mT).abs().max()) < 1e-13 * float(matrix.abs().max())
    assert float(torch.linalg.eigvalsh(matrix).min()) > 0


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize(("cells", "wraps"), [(2, False), (2, True), (5, False), (6, True)])
def test_interpolation_is_the_transpose_of_restriction_and_keeps_constants(axis, cells, wraps):
    shape = tuple(cells if a == axis else 3 for a in AXES)
    operator = patchy_box(shape, wraps)
    coarsening, coarse = Passes().coarsen(operator, axis)
    fine, u = random_values(2, *shape, seed=5), random_values(2, *coarse.loss.shape[1:], seed=6)
    down, up = (restrict(coarsening, fine) * u).sum(), (fine * prolong(coarsening, u)).sum()
    torch.testing.assert_close(down, up, rtol=1e-13, atol=0)
    assert torch.equal(prolong(coarsening, torch.ones_like(u)), torch.ones_like(fine))
    torch.testing.assert_close(coarse.loss.sum(), operator.loss.sum())


@pytest.mark.parametrize("wraps", [False, True])
def test_few_cells_are_solved_directly(wraps):
    operator, u = patchy_box((3, 4, 5), wraps), random_values(2, 3, 4, 5, seed=7)
    source, matrix = operator.apply(u), matrix_of(operator)
    torch.testing.assert_close(matrix, dense_matrix(operator))
    torch.testing.assert_close((matrix @ u.flatten(1)[..., None]).view_as(u), source)
    torch.testing.assert_close(Passes().solve(matrix.inverse(), source), u)


# --- iterations ---


@pytest.mark.parametrize("form", FORMS)
@each_dtype
def test_boxes_and_cells_of_any_form_take_few_iterations(form, dtype):
    shape, sides = FORMS[form]
    operator, source = uneven(shape, sides, dtype=dtype), random_values(2, *shape, dtype=dtype)
    assert solve_by_multigrid(operator, source, None, 1e-6).iterations <= 15


@each_dtype
def test_patches_of_a_million_to_one_take_few_iterations(dtype):
    """Random in every cell they take more, but less than a third of conjugate gradients alone."""
    source = random_values(1, 16, 16, 16, dtype=dtype)
    assert solve_by_multigrid(patchy(4, dtype), source, None, 1e-6).iterations <= 15
    operator = patchy(1, dtype)
    few, (u, many) = (
        solve_by_multigrid(operator, source, None, 1e-6),
        solve_by_gradients(operator, source, 1e-6),
    )
    assert 3 * few.iterations < many
    torch.testing.assert_close(few.value, u, rtol=0, atol=1e-3 * float(u.max()))


@each_dtype
@pytest.mark.parametrize("is_uneven", [False, True])
def test_the_residual_is_reached_and_no_step_leads_away(dtype, is_uneven):
    """By diagonal^(-1/2), relative to the source, for every color."""
    operator = uneven((4, 9, 5), dtype=dtype) if is_uneven else patchy_box((4, 9, 5))
    operator = Operator(tuple(c.to(dtype) for c in operator.conductances), operator.loss.to(dtype))
    source, tolerance = random_values(2, 4, 9, 5, seed=3, dtype=dtype), TOLERANCES[dtype]
    solution = solve_by_multigrid(operator, source, None, tolerance)
    assert solution.residual <= tolerance and solution.iterations > 0
    exact, scale = in_double(operator), operator.diagonal.double().rsqrt()
    residual = scale * (source.double() - exact.apply(solution.value.double()))
    sizes = [field.flatten(1).norm(dim=1) for field in (residual, scale * source.double())]
    assert float((sizes[0] / sizes[1]).max()) < 2 * tolerance
    again = solve_by_multigrid(operator, source, solution.value, 10 * tolerance)
    assert again.iterations == 0
    torch.testing.assert_close(again.value, solution.value)


@pytest.mark.parametrize("losses", [1, 3])
def test_colors_do_not_mix_and_may_share_conductances(losses):
    operator, source = patchy_box((6, 9, 7), colors=3), random_values(3, 6, 9, 7)
    faces, loss = [c[:1] for c in operator.conductances], operator.loss[:losses]
    together = solve_by_multigrid(Operator(tuple(faces), loss), source, None, 1e-11).value
    for c in range(3):
        of_color = Operator(tuple(faces), loss[c : c + 1] if losses == 3 else loss)
        alone = solve_by_multigrid(of_color, source[c : c + 1], None, 1e-11).value
        torch.testing.assert_close(together[c : c + 1], alone, rtol=1e-8, atol=0)


GUESSES = {
    "far": 1e9 * random_values(2, 4, 5, 3),
    "of another grid": random_values(2, 3, 3, 3),
    "not finite": torch.full((2, 4, 5, 3), math.nan).double(),
}


@pytest.mark.parametrize("guess", GUESSES.values(), ids=GUESSES)
def test_a_useless_start_does_no_harm(guess):
    """One that is worse than zero is not used."""
    operator, source = patchy_box((4, 5, 3)), random_values(2, 4, 5, 3, seed=3)
    warm, known = (solve_by_multigrid(operator, source, u, 1e-8).value for u in (guess, None))
    assert torch.equal(warm, known)


def test_no_source_no_light():
    solution = solve_by_multigrid(patchy_box((4, 5, 3)), torch.zeros(2, 4, 5, 3), None, 1e-8)
    assert solution.iterations == 0 and solution.residual == 0 and not solution.value.any()


@pytest.mark.parametrize("where", ["nowhere", "source", "loss"])
def test_a_solve_that_does_not_converge_says_so(where, monkeypatch):
    """For want of iterations, or since a number is not finite."""
    operator, source = patchy_box((4, 5, 3)), random_values(2, 4, 5, 3, seed=3)
    spoiled = {"source": source, "loss": operator.loss}
    if where in spoiled:
        spoiled[where][0, 0, 0, 0] = math.nan
    monkeypatch.setattr(solve, "MAX_ITERATIONS", 1)
    with pytest.raises(SolveError, match="multigrid did not reach") as caught:
        solve_by_multigrid(operator, source, None, 1e-12)
    assert caught.value.iterations <= 1 and not caught.value.residual <= 1e-12


# --- derivatives and memory ---

MODES: dict[str, Any] = {"check_forward_ad": True, "fast_mode": True}
TO_ROUNDING = {"eps": 1e-5, "atol": 1e-8, "rtol": 1e-7, **MODES}


def solving(memory=None):
    """u as a function of source, loss and the three conductances, solved to rounding."""
    solver = SolverWithMemory(solve_by_multigrid, 1e-14, memory or SolveMemory())
    return lambda source, loss, *conductances: solve_diffusion(
        solver, Operator(conductances, loss), source
    )


def inputs(shape=(2, 3, 2), colors=2):
    """Source, loss and conductances; a source of two colors may have a gray operator."""
    operator = patchy_box(shape, colors=colors)
    return [random_values(2, *shape) - 0.5, 1 + operator.loss, *operator.conductances]


@pytest.mark.parametrize(
    ("shape", "colors", "varied"),
    [
        *((shape, 2, range(5)) for shape in [(2, 3, 2), (1, 2, 4), (1, 1, 1)]),
        *(((2, 3, 2), 2, [one]) for one in range(5)),
        ((2, 3, 2), 1, range(5)),
    ],
)
def test_both_derivatives_agree_with_differences(shape, colors, varied):
    """By all arguments or by one; and where a gray operator serves a colored source."""
    arguments = inputs(shape, colors)
    for index in varied:
        arguments[index].requires_grad_()
    assert torch.autograd.gradcheck(solving(), arguments, **TO_ROUNDING)


def test_the_adjoint_takes_what_the_forward_solve_prepared_of_the_operator(monkeypatch):
    source, loss, *conductances = (tensor.requires_grad_() for tensor in inputs())
    operator = Operator(tuple(conductances), loss)
    solver = SolverWithMemory(solve_by_multigrid, 1e-12, SolveMemory())
    u = solve_diffusion(solver, operator, source)

    def refuse(*_):
        raise AssertionError("prepared again")

    monkeypatch.setattr(hierarchy.Hierarchy, "of", refuse)
    solve_diffusion(solver, operator, 2 * source)
    torch.autograd.grad(u.sum(), loss)


def test_every_solve_is_recorded():
    memory = SolveMemory()
    source, *coefficients = inputs()
    u = solving(memory)(source.requires_grad_(), *coefficients)
    u.sum().backward()
    with forward_ad.dual_level():
        solving(memory)(forward_ad.make_dual(source.detach(), source.detach()), *coefficients)
    kinds = ["forward", "adjoint", "forward", "tangent"]
    assert [record.kind for record in memory.records] == kinds
    assert all(record.residual <= 1e-14 and record.seconds > 0 for record in memory.records)


@pytest.mark.parametrize("is_warm", [True, False])
def test_a_second_solve_starts_from_the_first(is_warm):
    memory, (source, loss, *faces) = SolveMemory(is_warm), inputs((4, 5, 3))
    for tolerance in (1e-10, 1e-9):
        solver = SolverWithMemory(solve_by_multigrid, tolerance, memory)
        solver("forward", Operator(tuple(faces), loss), source)
    assert memory.records[0].iterations > 0
    assert (memory.records[1].iterations == 0) == is_warm == (("forward", 0) in memory.last)
