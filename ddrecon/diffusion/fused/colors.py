"""Colors of what kernels are given, and of the cotangents of coefficients that they return."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.medium.coefficients import Medium

FLUX = "flux_z", "flux_y", "flux_x"
"""What kernels call Q1 along z, y, x."""


def remaining_scale(medium: Medium) -> Tensor:
    """(1 - f) kappa_s per unit of the field of kappa_s, `[C, 1, 1, 1]`."""
    return (1 - medium.forward_fraction) * medium.scattering.scale


def per_color(scale: Tensor, colors: int) -> Tensor:
    """`scale`, of one color or of all, for each of `colors`."""
    return scale.expand(colors, 1, 1, 1)


def name_flux(flux: Sequence[Tensor]) -> dict[str, Tensor]:
    """Q1 by its names; nothing where there is none."""
    return dict(zip(FLUX, flux, strict=True)) if flux else {}


def empty_bars(**tensors: Tensor) -> dict[str, Tensor]:
    """Room for the cotangents of `tensors`, by their names."""
    return {f"{name}_bar": torch.empty_like(tensor) for name, tensor in tensors.items()}


class FieldBar:
    """The cotangent of a coefficient `scale` times `field`, which a kernel finds.

    That is one field for each color where the `scale` varies too or fields differ, else their sum.
    """

    def __init__(self, scale: Tensor, field: Tensor, colors: int, varies_scale: bool):
        self.scale, self.field, self.varies_scale = scale, field, varies_scale
        count = colors if varies_scale else len(field)
        self.bar = field.new_empty(count, *field.shape[1:])
        self.factor = per_color(torch.ones_like(scale) if varies_scale else scale, colors)

    def split(self) -> tuple[Tensor | None, Tensor]:
        """Cotangents of scale and field."""
        if not self.varies_scale:
            return None, self.bar
        return total(self.field * self.bar, self.scale), (self.scale * self.bar).sum_to_size(
            self.field.shape
        )


def total(bar: Tensor, like: Tensor) -> Tensor:
    """The sum of `bar` over what it has more than `like`, in double precision."""
    return bar.sum((1, 2, 3), keepdim=True, dtype=torch.float64).sum_to_size(like.shape).to(like)


