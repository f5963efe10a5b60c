"""A phase function that differs from cell to cell, as view rays see light of beams scattered by it.

The number that differs is interpolated to the nodes of rays, as density is. There S of E8.7 is a
polynomial in it (docs/theory.md E8.9), whose coefficients are kept over the angle beside those over
the depth. Of Henyey and Greenstein's function that is S over p, so that S is exact without a peak.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from ddrecon.medium.phase import (
    HenyeyGreenstein,
    PhaseFunction,
    PhaseKind,
    remember_of_phase,
)
from ddrecon.numerics.angle_table import STEPS
from ddrecon.numerics.chebyshev import COEFFICIENTS, extrema
from ddrecon.numerics.legendre import legendre_at_even_angles, series_weights

WEIGHT_POWERS = 4
"""Coefficients over a weight: S of two forward lobes is within about 2 % of E8.7."""
STEEPEST = 0.99
"""The largest g of tables. Over artanh g up to there, S has as many coefficients as over depth."""


def is_scaled(kind: PhaseKind) -> bool:
    """Whether the number is g, and tables have S over p; else p is linear in it, a weight."""
    return kind is HenyeyGreenstein


def count_powers(phase: PhaseFunction, has_peak: bool) -> int:
    """Coefficients of S over the number that differs from cell to cell, 1 where none does."""
    if phase.cells is None:
        return 1
    if is_scaled(phase.kind):
        return COEFFICIENTS if has_peak else 1
    return WEIGHT_POWERS if has_peak else 2


def number_place(kind: PhaseKind, number: Tensor) -> Tensor:
    """`number` from -1 to 1 in polynomials: of a weight, or of g by its artanh, 0 and less as 0."""
    if not is_scaled(kind):
        return 2 * number - 1
    g = torch.where(number > 0, number, torch.zeros_like(number))
    g = torch.where(g < STEEPEST, g, torch.full_like(g, STEEPEST))
    return torch.atanh(g) / (math.atanh(STEEPEST) / 2) - 1


def number_table(
    phase: PhaseFunction, make: Callable[..., Tensor], powers: int, sign: int, *arguments: int
) -> Tensor:
    """Coefficients over the number of the tables that `make` has of `phase` and `arguments`.

    They are [C, steps + 1, 2, `powers` K], of tables [C, steps + 1, 2, K]. `sign` is that of g.
    """
    numbers = _numbers(is_scaled(phase.kind), powers, sign, phase.numbers[0].device)
    return _fit(phase.with_cells(numbers), make, *arguments)


@functools.cache
@torch.inference_mode(False)
def _numbers(is_g: bool, powers: int, sign: int, device: torch.device) -> Tensor:
    """The numbers [`powers`] at which polynomials are fitted."""
    places, *_ = extrema(powers)
    half = (places + 1) / 2
    return (sign * torch.tanh(math.atanh(STEEPEST) * half) if is_g else half).to(device)


@remember_of_phase
def _fit(phase: PhaseFunction, make: Callable[..., Tensor], *arguments: int) -> Tensor:
    """As `number_table`, of a `phase` with all numbers at which polynomials are fitted."""
    # one after the other: weak peaks have short series
    phases = [phase.with_cells(number) for number in phase.numbers[-1]]
    tables = torch.stack([make(at_number, *arguments) for at_number in phases])
    if is_scaled(phase.kind):
        plain, rise = torch.stack([_value_table(one) for one in phases]).unbind(-2)
        values, slopes = tables.unbind(-2)
        values = values / plain
        tables = torch.stack([values, (slopes - values * rise) / plain], -2)
    *_, to_series = extrema(len(phases))
    coefficients = torch.tensordot(to_series.to(tables), tables, 1)
    return coefficients.movedim(0, -2).flatten(-2).contiguous()


def _value_table(phase: PhaseFunction) -> Tensor:
    """p as a table [C, steps + 1, 2, 1], summed as tables of S are."""
    weights = series_weights(phase.moments(phase.length()).double())
    curves = legendre_at_even_angles(STEPS, weights.shape[1])
    return torch.stack([weights @ rows.to(weights).T for rows in curves], -1)[..., None]
