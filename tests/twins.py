"""Twins: what both engines make of a function or a scene, and of its derivatives in both modes."""

from collections.abc import Callable, Sequence

import torch
from media import random_values
from torch import Tensor
from torch.autograd import forward_ad

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import use_engine
from ddrecon.picture import render_each
from ddrecon.scene import Scene
from ddrecon.variables.values import value_of, with_values

Tensors = dict[str, Tensor]
Function = Callable[[Tensors], Sequence[Tensor]]


def differentiate(
    engine: str, function: Function, values: Tensors, has_tangent: bool = False
) -> Tensors:
    """The results of `function` of named `values`, and derivatives of a random sum of them.

    Cotangents lie in memory as no result does. With the tangent along a random change of all
    `values`, if asked for.
    """
    use_engine(engine)
    leaves = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
    results = function(leaves)
    bars = [cotangent_of(result, 20 + k) for k, result in enumerate(results)]
    gradients = torch.autograd.grad(results, [*leaves.values()], bars, materialize_grads=True)
    found = {f"result {k}": result.detach() for k, result in enumerate(results)}
    found |= {f"by {name}": bar for name, bar in zip(values, gradients, strict=True)}
    if not has_tangent:
        return found
    with forward_ad.dual_level():
        duals = {n: forward_ad.make_dual(v.detach(), change_of(v, n)) for n, v in values.items()}
        tangents = [forward_ad.unpack_dual(result).tangent for result in function(duals)]
    return found | {f"tangent {k}": tangent for k, tangent in enumerate(tangents)}


def cotangent_of(result: Tensor, seed: int) -> Tensor:
    """A random one, stored as Fortran would."""
    backward = list(reversed(range(result.ndim)))
    shape = [result.shape[axis] for axis in backward]
    return random_values(*shape, seed=seed).to(result).permute(backward)


def change_of(value: Tensor, name: str) -> Tensor:
    """A random change of the variable `name`, of empty cells as well."""
    return random_values(*value.shape, seed=sum(map(ord, name))).to(value) - 0.3


def assert_same(found: Tensors, known: Tensors, error: float, least: float = 0.0) -> None:
    """Results agree to `error` of the largest number, derivatives to ten times that.

    What is smaller than `least` counts as that: sums over cells cancel in part.
    """
    assert found.keys() == known.keys()
    for name, value in known.items():
        bound = error if name.startswith("result") else 10 * error
        size = max(float(value.abs().max()), least)
        apart = float((found[name].to(value) - value).abs().max())
        assert apart <= bound * size, f"{name}: {apart:.2e} of {size:.2e}"


def assert_transposes(found: Tensors, values: Tensors, error: float = 1e-10) -> None:
    """Asserts <J v, w> = <v, J^T w> of what `differentiate` found, with a tangent, by `values`."""
    tangents = [found[f"tangent {k}"] for k in range(sum(name[:7] == "tangent" for name in found))]
    there = [t * cotangent_of(t, 20 + k) for k, t in enumerate(tangents)]
    back = [found[f"by {name}"] * change_of(value, name) for name, value in values.items()]
    sums = [torch.stack([terms.sum() for terms in side]).sum() for side in (there, back)]
    torch.testing.assert_close(*sums, rtol=error, atol=error)


def assert_twins(
    function: Function,
    values: Tensors,
    error: float = 1e-12,
    least: float = 0.0,
    has_tangent: bool = False,
) -> None:
    """Asserts that both engines agree, as `assert_same` says."""
    known, found = (
        differentiate(engine, function, values, has_tangent) for engine in ("torch", "warp")
    )
    assert_same(found, known, error, least)


def values_of(scene: Scene, names: Sequence[str]) -> Tensors:
    return {name: value_of(scene, name).detach() for name in names}


def images_of(scene: Scene) -> Function:
    """The images of `scene` as a function of its variables."""

    def render(values: Tensors) -> list[Tensor]:
        changed = with_values(scene, values)
        return render_each(changed, changed.views, SolveMemory())

    return render


def assert_render_twins(
    scene: Scene, names: Sequence[str], error: float = 1e-12, has_tangent: bool = False
) -> None:
    """Asserts that both engines render and differentiate `scene` alike."""
    assert_twins(images_of(scene), values_of(scene, names), error, has_tangent=has_tangent)
