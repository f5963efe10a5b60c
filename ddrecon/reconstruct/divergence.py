"""Why a reconstruction cannot go on: the parameter and the voxel that are to blame, in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ddrecon.errors import DivergenceError, SolveError
from ddrecon.reconstruct.parameters import Parameter


class NotFiniteError(Exception):
    """A number of the iteration being made is not finite; the text says which."""


def require_finite(parameters: Sequence[Parameter], gradients: Mapping[str, Tensor]) -> None:
    """Raises NotFiniteError where the derivative by one of the `parameters` is not finite."""
    for parameter in parameters:
        place = describe_flaw(parameter.name, gradients[parameter.name], parameter.is_field)
        if place is not None:
            raise NotFiniteError(
                f"the derivative of the loss with respect to {place} is not finite"
            )


def explain_divergence(
    iteration: int, parameters: Sequence[Parameter], error: SolveError | NotFiniteError
) -> DivergenceError:
    """What is raised where `iteration`, counted from 1, failed by `error`.

    It names the largest value of each of the `parameters`, and advises to bound them.
    """
    reason, residual, advice = str(error), math.nan, ""
    if isinstance(error, SolveError):
        residual = error.residual
        if math.isfinite(residual):
            reason, advice = reason.partition(";")[0], f"{error.advice}, or "
        else:
            reason = "the light is not finite"
    largest = list[str]()
    for parameter in parameters:
        values = parameter.value.detach()
        index = [int(i) for i in torch.unravel_index(values.abs().argmax(), values.shape)]
        place = _name_entry(parameter.name, index, parameter.is_field)
        largest.append(f"{place} is {float(values[tuple(index)]):.4g}")
    names = " and ".join(f"optimize.parameters.{parameter.name}" for parameter in parameters)
    return DivergenceError(
        iteration,
        f"{reason}; at most, {'; '.join(largest)}",
        residual,
        f"{advice}give another start (init) or bounds (min, max) to {names}",
    )


def describe_flaw(name: str, values: Tensor, is_field: bool) -> str | None:
    """The first entry of `values` that is not finite, as `density at voxel [x, y, z]`, or None.

    `values` belong to the parameter `name`.
    """
    flaws = torch.nonzero(~torch.isfinite(values.detach()))
    return _name_entry(name, flaws[0].tolist(), is_field) if len(flaws) else None


def _name_entry(name: str, index: list[int], is_field: bool) -> str:
    """An entry of the parameter `name` in words, its `index` in world order.

    Places are the last three numbers of the index into a field, the last two of that into a map.
    """
    if not is_field and len(index) != 3:
        return f"{name}, entry {index}" if index else name
    kind, count = ("voxel", 3) if is_field else ("pixel", 2)
    place, color = index[-count:][::-1], index[:-count]
    return f"{name} at {kind} {place}" + (f", color {color[0]}" if color else "")
