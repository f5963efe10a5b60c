"""What leaves a volume along rays, from the integrals along them, by fused kernels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.kernels.text import TextKernel, cut
from ddrecon.march.fused.compose_kernels import compose_kernel, decompose_kernel
from ddrecon.numerics.autodiff import differentiate_once, is_forward
from ddrecon.numerics.remember import remember

LENGTH = 2048
"""Rays that an item of a launch does on a processor."""
FEW = 1 << 16
"""So many rays are not worth a second thread."""


def compose(
    out: Tensor,
    masses: Tensor,
    scale: Tensor,
    scattering: Tensor,
    irradiances: Sequence[Tensor],
    factors: Sequence[Tensor | None],
    remaining: Tensor | None = None,
) -> Tensor:
    """Scattered radiance and opacity [2 C, R].

    `out` [C (1 + beams), R] and `masses` [K, R] are the integrals; `scale` and `scattering` [C or
    1] those of both coefficients. What does not change along a ray is multiplied in here: the
    `irradiances` of beams [C or 1], and p where it is one of the `factors` [1 or C, R] (E2); the
    scale of kappa_s, or for diffuse light that of what is `remaining`, where given; and E1's
    1 - tau of what is behind.
    """
    remaining = scattering if remaining is None else remaining
    scales = scale, scattering, remaining
    fixed = [*scales, *irradiances, *(each for each in factors if each is not None)]
    colors = len(out) // (1 + len(irradiances))
    has_colors = any(each is not None and len(each) > 1 for each in factors)
    if has_colors or is_forward() or any(each.requires_grad for each in fixed):
        return _compose(colors, out, masses, scale, scattering, irradiances, factors, remaining)
    weights = _weights(colors, *scales, *irradiances)
    composed: Tensor = _Compose.apply(out, masses, weights, _phases(out.shape[1], *factors))
    return composed


def _compose(
    colors: int,
    out: Tensor,
    masses: Tensor,
    scale: Tensor,
    scattering: Tensor,
    irradiances: Sequence[Tensor],
    factors: Sequence[Tensor | None],
    remaining: Tensor,
) -> Tensor:
    """The same by torch's operations."""
    diffuse, *arriving = out.split(colors)
    scattered = diffuse * remaining.view(-1, 1)
    for irradiance, light, factor in zip(irradiances, arriving, factors, strict=True):
        weighted = light if factor is None else light * factor
        strength = scattering.view(-1, 1) * irradiance.view(-1, 1) / (4 * math.pi)
        scattered = scattered + weighted * strength
    opacity = -torch.expm1(-scale.view(-1, 1).expand(colors, 1) * masses)
    return torch.cat([scattered, opacity])


@remember
def _weights(
    colors: int, scale: Tensor, scattering: Tensor, remaining: Tensor, *irradiances: Tensor
) -> Tensor:
    """The weights [2 + beams, C]: extinction's scale, and what diffuse light and beams count."""
    strengths = [each.view(-1) / (4 * math.pi) * scattering.view(-1) for each in irradiances]
    rows = scale.view(-1), remaining.view(-1), *strengths
    return torch.stack([row.expand(colors) for row in rows])


@remember
def _phases(rays: int, *factors: Tensor | None) -> Tensor | None:
    """The `factors` [beams, R] as one tensor; None where there are none."""
    known = [each for each in factors if each is not None]
    if not known:
        return None
    return torch.cat([torch.ones_like(known[0]) if f is None else f for f in factors])


class _Compose(torch.autograd.Function):
    """Differentiable by the integrals."""

    @staticmethod
    def forward(
        ctx: Any, out: Tensor, masses: Tensor, weights: Tensor, phases: Tensor | None
    ) -> Tensor:
        ctx.save_for_backward(masses, weights, phases)
        ctx.outputs = len(out)
        composed = out.new_empty(2 * weights.shape[1], out.shape[1])
        given = {"out": out, "masses": masses, "weights": weights, "phases": phases}
        _launch(compose_kernel(torch.finfo(out.dtype).bits), given, {"composed": composed})
        return composed

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, composed_bar: Tensor) -> tuple[Tensor | None, ...]:
        masses, weights, phases = ctx.saved_tensors
        out_bar, masses_bar = (
            masses.new_empty(ctx.outputs, masses.shape[1]),
            masses.new_empty(masses.shape),
        )
        given = {"composed": composed_bar, "masses": masses, "weights": weights, "phases": phases}
        made = {"out": out_bar, "masses_bar": masses_bar}
        _launch(decompose_kernel(torch.finfo(masses.dtype).bits), given, made)
        return out_bar, masses_bar, None, None


def _launch(kernel: TextKernel, given: dict[str, Tensor | None], made: dict[str, Tensor]) -> None:
    masses, weights = given["masses"], given["weights"]
    assert masses is not None and weights is not None
    rays = masses.shape[1]
    items, length = cut(rays, LENGTH, masses)
    numbers = {"length": length, "total": rays, "channels": len(masses)}
    numbers |= {"colors": weights.shape[1], "beams": len(weights) - 2}
    kernel.launch(items, given | numbers, made, 1 if rays < FEW else None)
