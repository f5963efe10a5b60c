"""Fused kernels of diffusion compute what torch does: values, cotangents, as many iterations."""

from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from graphics_cards import assert_compiles
from media import assert_near, box_grid, half_empty, random_values
from test_solve import FORMS, in_double, patchy, patchy_box, uneven
from twins import assert_twins

from ddrecon.diffusion.cells import average, bend
from ddrecon.diffusion.conservative import DiffusionProblem
from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solve import TensorSteps, solve_by_multigrid
from ddrecon.engine import use_engine
from ddrecon.medium.coefficients import Volume, scale_medium

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from as_on_a_gpu import ORDERS, as_on_a_gpu, headers_of

from ddrecon.diffusion.fused.cells import GIVEN, PLACE
from ddrecon.diffusion.fused.passes import KernelSteps
from ddrecon.kernels.cell_function import RowFunction

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("shape", [(2, 5, 4, 6), (1, 2, 3, 1), (1, 1, 1, 1)], ids=str)
def test_means_and_bends_in_cells_agree(shape):
    values = {"field": random_values(*shape)}

    def find(of):
        return [torch.stack([average(of["field"]), bend(of["field"])])]

    assert_twins(find, values, 1e-13, least=1.0)


def system_and_flux(shape, periodic=()):
    """All that a diffusion problem is asked for, as a function of medium, source and light."""
    grid = replace(box_grid(shape), periodic=periodic)

    def find(values):
        medium = [values[name] for name in ("density", "sigma_a", "sigma_s", "g")]
        scaled, closure = scale_medium(Volume(grid, *medium)), lambda k: 1 / (3 * k + 0.5)
        problem = DiffusionProblem(scaled, closure, values["source"], values["outside"], True)
        (operator, right), mean = problem.system, values["mean"]
        flux = problem.flux(mean)
        off = problem.flux(mean, more=flux.roll(1, 0), before=flux.roll(2, 0))
        side = problem.right_side(mean, flux)
        return [*operator.conductances, operator.loss, right, flux, off, side]

    return find


def system_values(shape, colors, has_fields=False, is_directed=True):
    cells, (of_medium, of_light) = shape if has_fields else (), colors
    sources = random_values(4 if is_directed else 1, *shape, of_light, seed=11)
    return {
        "density": 5 * half_empty(*shape),
        "sigma_a": random_values(of_medium, *cells, seed=7),
        "sigma_s": 6 * random_values(of_medium, *cells, seed=8),
        "g": torch.tensor(0.4, dtype=torch.float64),
        "source": sources.movedim(-1, 1),
        "outside": random_values(of_light, 1, 1, 1, seed=3),
        "mean": random_values(of_light, *shape, seed=5),
    }


SYSTEMS = [
    ((5, 7, 19), (1, 1), True, True),
    ((5, 7, 19), (1, 3), False, False),
    ((5, 7, 19), (3, 3), False, True),
    ((1, 4, 3), (1, 3), True, False),
    ((3, 1, 1), (3, 3), True, True),
]


@pytest.mark.parametrize(("shape", "colors", "has_fields", "is_directed"), SYSTEMS, ids=str)
def test_systems_and_fluxes_agree(shape, colors, has_fields, is_directed):
    values, find = system_values(shape, colors, has_fields, is_directed), system_and_flux(shape)
    assert_twins(find, values, least=1e-2)
    single = {name: value.float() for name, value in values.items()}
    assert_twins(find, single, 1e-5, least=1e-2)


@pytest.mark.parametrize(("shape", "periodic"), [((5, 4, 9), (0, 2)), ((3, 4, 1), (1, 2))])
def test_around_a_period_they_agree(shape, periodic):
    assert_twins(system_and_flux(shape, periodic), system_values(shape, (1, 3)), least=1e-2)


# --- solves ---

SHAPES = [(1, 1, 1), (1, 1, 9), (1, 12, 17), (9, 1, 1), (2, 3, 40), (7, 8, 9), (16, 5, 11)]


def solve(engine, operator, source, tolerance, guess=None):
    use_engine(engine)
    return solve_by_multigrid(replace(operator, prepared={}), source, guess, tolerance)


def assert_steps_agree(operator, seed=4):
    """Those of an iteration, one after another: V-cycle, direction and solution, and their sums."""
    source = random_values(*operator.loss.shape, seed=seed) - 0.5
    pairs = [KernelSteps(operator, source), TensorSteps(operator, source)]
    for steps in pairs:
        steps.numbers.copy_(random_values(*steps.numbers.shape, seed=2))
        steps.direction.copy_(source.flip(1))
        steps.precondition()
        steps.turn()
        steps.advance()
    names = "preconditioned", "direction", "product", "residual", "solution", "numbers"
    for name in names:
        assert_near(*(getattr(steps, name) for steps in pairs), 1e-12)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_a_cycle_and_a_solve_are_those_of_torch(shape):
    """Of one color or two, in a box or around it; they take as many iterations."""
    for colors, wraps in ((2, False), (1, True)):
        assert_steps_agree(patchy_box(shape, wraps, colors))
    operator, source = uneven(shape), random_values(2, *shape)
    actual, known = (solve(engine, operator, source, 1e-9) for engine in ("warp", "torch"))
    assert actual.iterations == known.iterations
    assert_near(actual.value, known.value, 1e-7)
    assert solve("warp", operator, source, 1e-8, actual.value).iterations == 0


@pytest.mark.parametrize("order", ORDERS)
def test_an_item_may_be_a_cell_in_any_order(order):
    with as_on_a_gpu(order) as launched:
        for wraps in (False, True):
            assert_steps_agree(patchy_box((7, 8, 9), wraps))
    assert "diffusion/fused/passes.h" in headers_of(launched)


@pytest.mark.parametrize("form", FORMS)
def test_grids_are_those_of_torch(form):
    """The same axes are coarsened on every level, also where cells are not cubes, and on a GPU."""
    for place in (nullcontext(), as_on_a_gpu()):
        with place:
            assert_steps_agree(uneven(*FORMS[form]))


@pytest.mark.parametrize(("patch", "dtype"), [(1, torch.float32), (4, torch.float64)], ids=str)
def test_a_million_to_one(patch, dtype):
    operator, source = patchy(patch, dtype), random_values(1, 16, 16, 16, dtype=dtype)
    actual, known = (solve(engine, operator, source, 1e-6) for engine in ("warp", "torch"))
    assert abs(actual.iterations - known.iterations) <= 0.1 * known.iterations
    exact = solve("torch", in_double(operator), source.double(), 1e-12).value
    errors = [float((u.value - exact).norm()) for u in (actual, known)]
    assert errors[0] <= 2 * errors[1]


@pytest.mark.parametrize("losses", [1, 3])
def test_colors_share_conductances(losses):
    operator, source = uneven((6, 9, 7)), random_values(3, 6, 9, 7)
    loss = operator.loss[:1] + torch.arange(losses, dtype=torch.float64).view(-1, 1, 1, 1)
    shared = Operator(tuple(c[:1] for c in operator.conductances), loss)
    actual, known = (solve(engine, shared, source, 1e-10) for engine in ("warp", "torch"))
    assert actual.iterations == known.iterations
    assert_near(actual.value, known.value, 1e-8)


def test_kernels_compile_for_graphics_cards(tmp_path):
    header, place = "diffusion/fused/faces.h", (1, PLACE, GIVEN)
    system = RowFunction(header, "Flow<SYSTEM, 1, 0>", ((),) * 5, *place)
    flux = RowFunction(header, "Flow<FLUX, 1, 3>", ((3, 1, 1, 1, 1),), *place)
    assert_compiles([system.kernel("tangents", 7, 32), flux.kernel("values", 9, 64)], tmp_path)
