"""The fused kernels of a sweep compute what PyTorch's operations compute, derivatives included."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
import torch.autograd.forward_ad as forward
from graphics_cards import assert_compiles
from media import half_empty, make_scene, random_values
from sweep_cases import CUBES, FLAT, THIN, Case
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.diffusion.rounds.sweep import DIRECTIONS, sweep_change
from ddrecon.diffusion.rounds.transport import _blend, _gain
from ddrecon.engine import use_engine
from ddrecon.light.moments import Moments
from ddrecon.medium.remaining import remaining_moments
from ddrecon.renderer import solve_light

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from ddrecon.diffusion.rounds.fused.by_cells import cell_kernel
from ddrecon.diffusion.rounds.fused.sweep import sweep_fused

pytestmark = pytest.mark.slow


def moments_of(case: Case, values: dict[str, Tensor], engine: str) -> list[Tensor]:
    use_engine(engine)
    medium = case.medium(values)
    light, source = Moments.of_harmonics(values["light"]), case.source(values)
    swept = sweep_change(medium, light, source, values.get("inflow"), case.degree)
    return [swept.harmonics(medium.degree)]


def moments_by_cells(case: Case, values: dict[str, Tensor], _: str) -> list[Tensor]:
    """As a GPU does it."""
    medium = case.medium(values)
    light, source = Moments.of_harmonics(values["light"]), case.source(values)
    factors = remaining_moments(medium)[: medium.degree + 1]
    number = DIRECTIONS[case.degree]
    swept = sweep_fused(medium, light, factors, source, values.get("inflow"), number, True)
    return [swept.harmonics(medium.degree)]


def gradients(
    case: Case, engine: str, function=moments_of, varied: list[str] | None = None
) -> tuple[list[Tensor], dict[str, Tensor]]:
    """The moments, and the derivatives of a random functional of them, by name."""
    leaves = case.values()
    names = varied or list(leaves)
    for name in names:
        leaves[name] = leaves[name].requires_grad_()
    moments = function(case, leaves, engine)
    weights = [random_values(*m.shape, seed=9 + i).to(m) for i, m in enumerate(moments)]
    total = sum((m * weight).sum() for m, weight in zip(moments, weights, strict=True))
    found = torch.autograd.grad(total, [leaves[name] for name in names], materialize_grads=True)
    return [m.detach() for m in moments], dict(zip(names, found, strict=True))


def assert_near(found: Tensor, known: Tensor, error: float) -> None:
    assert bool(torch.isfinite(found).all())
    assert float((found - known).abs().max()) <= error * float(known.abs().max())


def assert_same(one: tuple, other: tuple, error: float) -> None:
    """Moments agree to `error` of the mean, and derivatives to ten times that."""
    bound = float(other[0][0].abs().max())
    for found, known in zip(one[0], other[0], strict=True):
        assert float((found - known).abs().max()) <= error * bound
    for name, known in other[1].items():
        assert_near(one[1][name], known, 10 * error)


CASES = {
    "color": Case(),
    "begun": Case(known=4),
    "beam": Case(known=4, is_beam=True),
    "cubes": Case(spacing=CUBES),
    "thin": Case(spacing=THIN, moments=4),
    "gray": Case(colors=1, moments=1, is_lit=False),
    "gray-4": Case(colors=1, moments=4, known=4, spacing=CUBES),
    "fields": Case(varies=True, moments=4),
    "gray-fields": Case(varies=True, colors=1, moments=1, is_lit=False, spacing=CUBES),
    "50": Case(degree=5, moments=36, spacing=CUBES),
    "86": Case(degree=7, moments=64, colors=1, spacing=(1.0, 0.7, 0.9)),
    "wide": Case((3, 4, 35), CUBES),
    "wider": Case((3, 4, 70), THIN, degree=5, colors=1),
    "line-x": Case((1, 1, 9)),
    "line-y": Case((1, 9, 1), CUBES),
    "line-z": Case((19, 1, 1), CUBES, moments=4),
    "sheet": Case((4, 1, 5), CUBES),
    "cell": Case((1, 1, 1), CUBES),
    "opaque": Case(depth=1e4, spacing=CUBES),
    "empty": Case(depth=0.0),
    "shallow": Case((6, 5, 37), CUBES, colors=1, moments=4, depth=0.1),
    "island": Case((7, 8, 70), CUBES, colors=1, is_island=True),
    "island-slanted": Case((7, 8, 70), FLAT, colors=1, is_island=True),
    "island-high": Case((25, 40, 7), colors=1, moments=1, is_island=True),
}
each_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES)


@each_case
def test_moments_and_gradients_are_those_of_torch(case: Case):
    assert_same(gradients(case, "warp"), gradients(case, "torch"), 1e-12)


@each_case
def test_a_thread_a_cell_computes_the_same(case: Case):
    assert_same(gradients(case, "warp", moments_by_cells), gradients(case, "torch"), 1e-12)


@pytest.mark.parametrize("spacing", [CUBES, FLAT], ids=str)
def test_single_precision(spacing: tuple[float, float, float]):
    """Beside the same numbers in double precision; rows have two vectors and a rest."""
    case = Case((4, 5, 37), spacing)
    single = gradients(replace(case, dtype=torch.float32), "warp")
    moments, found = gradients(case, "torch")
    assert_same(single, (moments, found), 2e-6)


@pytest.mark.parametrize("varied", [["source"], ["density", "inflow"]], ids=str)
def test_some_derivatives_are_asked_for(varied: list[str]):
    assert_same(
        gradients(Case(), "warp", varied=varied), gradients(Case(), "torch", varied=varied), 1e-12
    )


@pytest.mark.parametrize("function", [moments_of, moments_by_cells])
@pytest.mark.parametrize("name", ["beam", "fields"])
def test_the_adjoint_is_the_transpose_of_the_tangent(name: str, function):
    """<J v, w> = <v, J^T w>."""
    case = CASES[name]
    _, found = gradients(case, "warp", function)
    values = case.values()
    changes = {n: random_values(*v.shape, seed=30).to(v) for n, v in values.items()}
    with forward.dual_level():
        duals = {n: forward.make_dual(v, changes[n]) for n, v in values.items()}
        moments = function(case, duals, "warp")
        tangents = [forward.unpack_dual(moment).tangent for moment in moments]
    along = sum(
        float((t * random_values(*t.shape, seed=9 + i)).sum()) for i, t in enumerate(tangents)
    )
    back = sum(float((found[n] * changes[n]).sum()) for n in values)
    assert along == pytest.approx(back, rel=1e-10)


def test_the_same_threads_give_the_same_bits_and_others_the_same_numbers():
    case, threads = Case(degree=5), torch.get_num_threads()
    runs = []
    try:
        for count in (2, 2, 1, 3, 16):
            torch.set_num_threads(count)
            runs.append(gradients(case, "warp"))
    finally:
        torch.set_num_threads(threads)
    for one, same in zip(runs[0][0], runs[1][0], strict=True):
        assert torch.equal(one, same)
    for name, one in runs[0][1].items():
        assert torch.equal(one, runs[1][1][name])
    for other in runs[2:]:
        assert_same(other, runs[0], 1e-13)


def gains_of(case: Case, values: dict[str, Tensor], engine: str) -> list[Tensor]:
    """The source, and the gains where light changes by `source`.

    In the first round it is off by nothing; `light` stands for a later one, where it is lit.
    """
    use_engine(engine)
    medium = case.medium(values)
    change, light = (Moments.of_harmonics(values[name]) for name in ("source", "light"))
    off = light.scaled(values["inflow"], 0.5) if "inflow" in values else None
    gain, source, turned = _gain(medium, change, off, case.degree)
    return [source, gain.mean, *(gain.flux or ()), *(turned or ())]


def blended(case: Case, values: dict[str, Tensor], engine: str) -> list[Tensor]:
    """Light after a round."""
    use_engine(engine)
    medium, factor = case.medium(values), 0.4 + values["inflow"]
    swept, light = (Moments.of_harmonics(values[name]) for name in ("source", "light"))
    made = replace(swept.scaled(1.3, 1.2), higher=None)
    new = _blend(medium, light, made, swept.higher, factor, case.degree)
    return [new.harmonics(medium.degree)]


@pytest.mark.parametrize("name", ["color", "gray", "gray-4", "fields", "cell", "opaque"])
def test_gains_and_their_gradients_are_those_of_torch(name: str):
    one, other = (gradients(CASES[name], engine, gains_of) for engine in ("warp", "torch"))
    assert_same(one, other, 1e-11)


def test_gains_in_single_precision():
    single = gradients(replace(CASES["color"], dtype=torch.float32), "warp", gains_of)
    assert_same(single, gradients(CASES["color"], "torch", gains_of), 2e-6)


@pytest.mark.parametrize("name", ["color", "begun", "fields", "50", "opaque", "empty"])
def test_blended_light_and_its_gradients_are_those_of_torch(name: str):
    case = CASES[name] if CASES[name].moments > 4 else replace(CASES[name], moments=16)
    one, other = (gradients(case, engine, blended) for engine in ("warp", "torch"))
    assert_same(one, other, 1e-11)


@pytest.mark.parametrize("g", [0.0, 0.5])
def test_light_after_rounds_is_that_of_torch(g: float):
    scene = make_scene(
        half_empty(6, 7, 5),
        g=g,
        directional=(3.0,),
        ambient=(0.4,),
        transport_rounds=2,
        tolerance=1e-13,
    )

    def light(engine: str) -> tuple[Tensor, Tensor]:
        use_engine(engine)
        density = scene.volume.density.clone().requires_grad_()
        world = replace(scene, volume=replace(scene.volume, density=density))
        mean = solve_light(world, SolveMemory()).outgoing.mean
        (gradient,) = torch.autograd.grad(mean.square().sum(), density)
        return mean.detach(), gradient

    for found, known in zip(light("warp"), light("torch"), strict=True):
        assert_near(found, known, 1e-10)


def test_kernels_compile_for_graphics_cards(tmp_path: Path):
    functions = [
        "follow_cells<F, false>",
        "follow_cells<Dual<F>, true>",
        "return_cells<false, true>",
        "collect_cells<false>",
    ]
    assert_compiles([cell_kernel(function, 32) for function in functions], tmp_path)
