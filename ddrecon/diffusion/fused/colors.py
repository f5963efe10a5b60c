"""Colors of what kernels are given, and of the cotangents of coefficients that they return."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

FLUX = "flux_z", "flux_y", "flux_x"
"""What kernels call Q1 along z, y, x."""


def per_color(scale: Tensor, colors: int) -> Tensor:
    """`scale`, of one color or of all, for each of `colors`."""
    return scale.expand(colors, 1, 1, 1)


def name_flux(flux: Sequence[Tensor]) -> dict[str, Tensor]:
    """Q1 by its names; nothing where there is none."""
    return dict(zip(FLUX, flux, strict=True)) if flux else {}


def empty_bars(colors: int, **tensors: Tensor) -> dict[str, Tensor]:
    """Room for the cotangents of `tensors` in each of `colors`, by their names."""
    return {
        f"{name}_bar": tensor.new_empty(colors, *tensor.shape[1:])
        for name, tensor in tensors.items()
    }


def sum_colors(bar: Tensor, like: Tensor) -> Tensor:
    """The cotangent `bar` [C, z, y, x], summed where `like` has one color for all."""
    return bar if len(like) == len(bar) else bar.sum(0, keepdim=True)


class FieldBar:
    """The cotangent of a coefficient `scale` times `field`, which a kernel finds as `bar`.

    The kernel multiplies by `factor` [C], the scale, unless that varies too.
    """

    def __init__(self, scale: Tensor, field: Tensor, colors: int, varies_scale: bool):
        self.scale, self.field, self.varies_scale = scale, field, varies_scale
        self.bar = field.new_empty(colors, *field.shape[1:])
        self.factor = per_color(torch.ones_like(scale) if varies_scale else scale, colors)

    def split(self) -> tuple[Tensor | None, Tensor]:
        """Cotangents of scale and field."""
        if not self.varies_scale:
            return None, sum_colors(self.bar, self.field)
        field_bar = sum_colors(self.scale * self.bar, self.field)
        return total(self.field * self.bar, self.scale), field_bar


def total(bar: Tensor, like: Tensor) -> Tensor:
    """The sum of `bar` [C, z, y, x] over all that it has more than `like`, in double precision."""
    return bar.sum((1, 2, 3), keepdim=True, dtype=torch.float64).sum_to_size(like.shape).to(like)
