"""Moments of the scattering that remains once peaks count as not scattered, or as turned back."""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.remember import is_any_nonzero, remember


def remaining_moments(medium: Medium, degree: int) -> Tensor:
    """p_l = (chi_l - f) / (1 - f) for l up to `degree` (E18), [L + 1, C or 1, 1, 1, 1].

    chi_l are the moments of the phase function of `medium`, f the part of its forward peak.
    """
    return _remaining(medium.g, medium.forward_fraction, degree)


def unturned_moments(medium: Medium, degree: int) -> Tensor:
    """p_l - (-1)^l b / (1 - f), of what beams scatter that keep their backward peak b (E20).

    As `remaining_moments`.
    """
    turned = backward_fraction(medium, degree) / (1 - medium.forward_fraction)
    sign = 1 - 2 * (torch.arange(degree + 1, device=turned.device) % 2).to(turned)
    return remaining_moments(medium, degree) - sign.view(-1, 1, 1, 1, 1) * turned


def backward_fraction(medium: Medium, degree: int) -> Tensor:
    """b, the part of scattering that counts as turned back [C or 1, 1, 1, 1] (E20)."""
    return _backward_fraction(medium.g, degree)


def has_backward_peak(medium: Medium, degree: int) -> bool:
    """Whether a part of scattering counts as turned back."""
    return is_any_nonzero(backward_fraction(medium, degree))


@remember
def _remaining(g: Tensor, fraction: Tensor, degree: int) -> Tensor:
    power = torch.arange(degree + 1, dtype=g.dtype, device=g.device).view(-1, 1, 1, 1, 1)
    return (g.reshape(-1, 1, 1, 1) ** power - fraction) / (1 - fraction)


@remember
def _backward_fraction(g: Tensor, degree: int) -> Tensor:
    return (-g).clamp(min=0).reshape(-1, 1, 1, 1) ** (degree + 1)
