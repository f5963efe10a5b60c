"""The fused kernels of a sweep compute what PyTorch's operations compute, derivatives included."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
import torch.autograd.forward_ad as forward
from media import random_values
from sweep_cases import CUBES, FLAT, THIN, Case
from torch import Tensor

from ddrecon.diffusion.rounds.sweep import sweep_change
from ddrecon.engine import use_engine
from ddrecon.light.moments import Moments

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")

pytestmark = pytest.mark.slow


def moments_of(case: Case, values: dict[str, Tensor], engine: str) -> list[Tensor]:
    use_engine(engine)
    medium = case.medium(values)
    light, source = Moments.of_harmonics(values["light"]), case.source(values)
    swept = sweep_change(medium, light, source, values.get("inflow"), case.degree)
    return [swept.harmonics(medium.degree)]


def gradients(
    case: Case, engine: str, varied: list[str] | None = None
) -> tuple[list[Tensor], dict[str, Tensor]]:
    """The moments, and the derivatives of a random functional of them, by name."""
    leaves = case.values()
    names = varied or list(leaves)
    for name in names:
        leaves[name] = leaves[name].requires_grad_()
    moments = moments_of(case, leaves, engine)
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
    "thin": Case(spacing=THIN),
    "gray": Case(colors=1, moments=1, is_lit=False),
    "gray-begun": Case(colors=1, known=4, spacing=CUBES),
    "fields": Case(varies=True, moments=1),
    "gray-fields": Case(varies=True, colors=1, moments=1, is_lit=False, spacing=CUBES),
    "50": Case(degree=5, moments=36, spacing=CUBES),
    "wide": Case((3, 4, 35), CUBES),
    "wider": Case((3, 4, 70), THIN, degree=5, colors=1),
    "line-x": Case((1, 1, 9)),
    "line-y": Case((1, 9, 1), CUBES),
    "line-z": Case((19, 1, 1), CUBES),
    "sheet": Case((4, 1, 5), CUBES),
    "cell": Case((1, 1, 1), CUBES),
    "opaque": Case(depth=1e4, spacing=CUBES),
    "empty": Case(depth=0.0),
    "shallow": Case((6, 5, 37), CUBES, colors=1, depth=0.1),
    "island": Case((7, 8, 70), CUBES, colors=1, is_island=True),
    "island-slanted": Case((7, 8, 70), FLAT, colors=1, is_island=True),
    "island-high": Case((25, 40, 7), colors=1, moments=1, is_island=True),
}
each_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES)


@each_case
def test_moments_and_gradients_are_those_of_torch(case: Case):
    assert_same(gradients(case, "warp"), gradients(case, "torch"), 1e-12)


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


@pytest.mark.parametrize("name", ["beam", "fields"])
def test_the_adjoint_is_the_transpose_of_the_tangent(name: str):
    """<J v, w> = <v, J^T w>."""
    case = CASES[name]
    _, found = gradients(case, "warp")
    values = case.values()
    changes = {n: random_values(*v.shape, seed=30).to(v) for n, v in values.items()}
    with forward.dual_level():
        duals = {n: forward.make_dual(v, changes[n]) for n, v in values.items()}
        moments = moments_of(case, duals, "warp")
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
