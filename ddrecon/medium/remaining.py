"""Moments of the scattering that remains once peaks count as not scattered, or as turned back."""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.medium.coefficients import P1_DEGREE, Medium, peak_fraction
from ddrecon.medium.phase import PhaseFunction, henyey_greenstein
from ddrecon.medium.phase_peak import (
    is_scaled,
    number_place,
    number_table,
    peak_moments,
    tabulate_series,
)
from ddrecon.numerics.remember import is_any_nonzero, remember
from ddrecon.numerics.series import legendre, look_up, series_weights, sum_series


def remaining_moments(medium: Medium) -> Tensor:
    """p_l = (chi_l - f) / (1 - f) for l up to the medium's degree (E8.4), [L + 1, C or 1, 1, 1, 1].

    chi_l are the moments of the phase function of `medium`, f the part of its forward peak. Of one
    that differs from cell to cell they are [L + 1, C or 1, z, y, x].
    """
    return _remaining(medium.seen.phase, medium.forward_fraction, medium.seen.degree)


@remember
def _remaining(phase: PhaseFunction, fraction: Tensor, degree: int) -> Tensor:
    moments = phase.moments(degree + 1).transpose(0, 1)
    moments = moments if moments.ndim == 5 else moments[..., None, None, None]
    return (moments - fraction) / (1 - fraction)


def unturned_moments(medium: Medium) -> Tensor:
    """p_l - (-1)^l b / (1 - f), of what beams scatter that keep their backward peak b (E8.11).

    As `remaining_moments`.
    """
    turned = backward_fraction(medium) / (1 - medium.forward_fraction)
    moments = remaining_moments(medium)
    sign = 1 - 2 * (torch.arange(len(moments), device=turned.device) % 2).to(turned)
    return moments - sign.view(-1, 1, 1, 1, 1) * turned


def backward_fraction(medium: Medium) -> Tensor:
    """b, the part of scattering that counts as turned back (E8.11), shaped as f of `Medium`."""
    return peak_fraction(medium.seen.phase, medium.seen.degree, -1)


def has_backward_peak(medium: Medium) -> bool:
    """Whether a part of scattering counts as turned back: not by diffusion alone."""
    return medium.seen.degree > P1_DEGREE and is_any_nonzero(backward_fraction(medium))


@remember
def turned_table(phase: PhaseFunction, degree: int, turns: int) -> Tensor:
    """How light that a backward peak has turned scatters once more, towards a camera (E8.12).

    A table [C, steps + 1, 2, 1] for `look_up` over the angle from the way that light goes. Its
    moments are chi_l up to `degree`, and chi_l r_l^turns beyond, where r_l are the backward peak's;
    less the forward peak's, which counts as not scattered.
    """
    forward, _ = peak_moments(phase, degree)
    _, spread = peak_moments(phase, degree, -1)
    moments = phase.moments(phase.length()).double() - forward
    return tabulate_series(series_weights(moments * spread**turns)[..., None])


def turned_in_cells(medium: Medium, turns: int, angle: Tensor) -> Tensor:
    """How light turned so often scatters by `angle` [z, y, x] in cells, [C, z, y, x] (E8.12)."""
    phase, degree = medium.seen.phase, medium.seen.degree
    number = phase.cells
    assert number is not None
    cosine = angle.cos().to(number)
    table = number_table(phase, turned_table, True, -1, degree, turns).to(number)
    coefficients = look_up(table, angle.double()).unbind(-1)
    if not is_scaled(phase):
        return sum_series(coefficients, number_place(phase, number))
    turned = sum_series(coefficients, number_place(phase, -number))
    # Where g is positive nothing is turned back, and the forward peak counts as not scattered.
    moments = (phase.moments(degree + 1) - phase.peak_tail(degree, 1)).movedim(1, -1)
    forward = (series_weights(moments) * legendre(cosine, degree + 1)).sum(-1)
    return torch.where(number < 0, henyey_greenstein(cosine, number) * turned, forward)
