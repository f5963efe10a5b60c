"""What a number of a scene may be: its shape, precision, device and range."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ddrecon.errors import UsageError
from ddrecon.variables.kinds import PHASE, STEEPEST_G, XYZ, kind_of, split_name


def require_shape(name: str, value: Tensor | None, *shapes: tuple[int, ...]) -> None:
    """Raises UsageError unless `value` is None or has one of `shapes`."""
    if value is not None and tuple(value.shape) not in shapes:
        expected = " or ".join(str(list(shape)) for shape in dict.fromkeys(shapes))
        raise UsageError(f"{name}: has shape {list(value.shape)}; expected {expected}")


def is_real(value: object) -> bool:
    """Whether `value` is a tensor of real numbers, each in its place."""
    return isinstance(value, Tensor) and value.layout == torch.strided and not value.is_complex()


def require_form(
    name: str, value: Tensor, known: Tensor, like: Tensor, cells: tuple[int, ...]
) -> None:
    """Raises UsageError unless `value` can be the variable `name`, in place of `known`, on `cells`.

    Its precision and device are to be those of `like`. Nothing is read from a GPU.
    """
    if not isinstance(value, Tensor):
        raise UsageError(f"{name}: expected a tensor, found {type(value).__name__}")
    if not is_real(value):
        raise UsageError(f"{name}: is {value.dtype}, {value.layout}; expected real and strided")
    if (value.dtype, value.device) != (like.dtype, like.device):
        raise UsageError(
            f"{name}: is {value.dtype} on {value.device}, but the scene is {like.dtype} on "
            f"{like.device}; convert it by .to(...)"
        )
    require_shape(name, value, *shapes_in_place(name, tuple(known.shape), cells))


def require_range(name: str, value: Tensor) -> None:
    """Raises UsageError where `value` is not finite, or out of range for the variable `name`."""
    kind = kind_of(name)
    least, most = (float(end) for end in value.detach().aminmax())
    range_found = f"found {least:g}" if least == most else f"found {least:g} to {most:g}"
    if not math.isfinite(least + most):
        raise UsageError(f"{name}: must be finite, {range_found}")
    if kind.high == STEEPEST_G and not -1 < least <= most < 1:
        # A scene may scatter further forward than a run makes it.
        raise UsageError(f"{name}: must be above -1 and below 1, {range_found}")
    if kind.high != STEEPEST_G and not kind.low <= least <= most <= kind.high:
        bounds = f"at least {kind.low:g}" if kind.high == math.inf else f"from 0 to {kind.high:g}"
        raise UsageError(f"{name}: must be {bounds}, {range_found}")
    if kind.is_direction and least == most == 0:
        raise UsageError(f"{name}: must not be zero")


def shapes_in_place(
    name: str, shape: tuple[int, ...], cells: tuple[int, ...]
) -> list[tuple[int, ...]]:
    """The shapes that the variable `name` may have in place of its own `shape`."""
    kind, last = kind_of(name), split_name(name)[1]
    if last == "density":
        return [cells]
    if last.startswith(PHASE):
        return [shape, (), *((color, *tail) for color in (1, 3) for tail in ((), cells))]
    if kind.is_color:
        tails = [(), cells] if kind.is_cellwise else [shape[1:]]
        return [(color, *tail) for tail in tails for color in (1, 3)]
    if kind.is_cellwise:
        return [(), cells, (1, *cells)]
    return [(len(kind.components),)] if kind.components in (XYZ, XYZ[:2]) else [shape]
