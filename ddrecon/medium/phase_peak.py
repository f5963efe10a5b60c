"""What replaces the phase function for a beam seen along a view ray, whose peak was scaled out.

Light that the forward peak alone has scattered, often or once, is still on its way; at a depth x of
the peak it has spread (docs/theory.md E8.7, E8.6). Along a ray only x changes: the function is a
polynomial in (x - s) / (x + s), whose coefficients are kept over the angle.

Where a number of the phase function differs from cell to cell, it is interpolated to the nodes of
rays, as density is. There S of E8.7 is a polynomial in that number too (E8.9). Of Henyey and
Greenstein's function the polynomial is of S over p, so that S is exact without a peak.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.medium.phase import HenyeyGreenstein, PhaseFunction, henyey_greenstein
from ddrecon.numerics.decay import decay_mean
from ddrecon.numerics.remember import remember
from ddrecon.numerics.series import (
    COEFFICIENTS,
    STEPS,
    angle_of,
    depth_at,
    depth_place,
    evaluate,
    even_angles,
    extrema,
    legendre_at_even_angles,
    look_up,
    series_weights,
    sum_series,
    with_slopes,
)

WEIGHT_POWERS = 4
"""Coefficients over a weight: S of two forward lobes is within about 2 % of E8.7."""
STEEPEST = 0.99
"""The largest g of tables. Over artanh g up to there, S has as many coefficients as over depth."""


@dataclass(frozen=True, eq=False)
class SeenPhase:
    """A phase function as view rays see light of beams scattered by it.

    `phase`: the function; `degree`: light is known to this degree in angle, and peaks beyond it
    count as not scattered. Where `phase` differs from cell to cell, `number` [N, 1 or C, R] is that
    of its numbers which does, at N nodes of R rays.
    """

    phase: PhaseFunction
    degree: int
    number: Tensor | None = None

    def along(self, depth: Tensor | None, cosine: Tensor) -> Tensor:
        """S at `depth` [N, C, R], or p where that is None, along rays of one `cosine` [R] each.

        It is [N, C, R], or without depth and number [C, R].
        """
        if depth is None and self.number is None:
            return self.phase.value(cosine)
        return self._look_up(angle_of(cosine)[None], depth, cosine)

    def at_angles(self, depth: Tensor | None, angle: Tensor) -> Tensor:
        """S, or p where `depth` is None, [N, C, R] at `depth` [N, C, R] and `angle` [N, R]."""
        return self._look_up(angle, depth, angle.cos()[:, None])

    def _look_up(self, angle: Tensor, depth: Tensor | None, cosine: Tensor) -> Tensor:
        """As `at_angles`, with one `angle` [1, R] for all nodes of a ray as well."""
        has_peak, terms = depth is not None, 1 if depth is None else COEFFICIENTS
        coefficients = look_up(self.table(has_peak).to(cosine.dtype), angle.double())
        rows = coefficients.permute(3, 1, 0, 2).unflatten(0, (-1, terms))
        seen = [row[0] if depth is None else evaluate(row, depth_place(depth)) for row in rows]
        if self.number is None:
            return seen[0].clamp(min=0) if has_peak else seen[0]
        value = sum_series(seen, number_place(self.phase, self.number))
        value = value.clamp(min=0) if has_peak else value
        return henyey_greenstein(cosine, self.number) * value if is_scaled(self.phase) else value

    def table(self, has_peak: bool) -> Tensor:
        """Of S its coefficients, [C, steps + 1, 2, K], or without a peak of p the values.

        At even angles, with slopes by the angle (`numerics.series`), in double precision. Of a
        phase function that differs from cell to cell K is as `number_table` has it.
        """
        make, degree = (_peak_table, (self.degree,)) if has_peak else (_plain_table, ())
        if self.phase.cells is None:
            return make(self.phase, *degree)
        return number_table(self.phase, make, has_peak, 1, *degree)


def is_scaled(phase: PhaseFunction) -> bool:
    """Whether the number is g, and tables have S over p; else p is linear in it, a weight."""
    return isinstance(phase, HenyeyGreenstein)


def count_powers(phase: PhaseFunction, has_peak: bool) -> int:
    """Coefficients of S over the number that differs from cell to cell, 1 where none does."""
    if phase.cells is None:
        return 1
    if is_scaled(phase):
        return COEFFICIENTS if has_peak else 1
    return WEIGHT_POWERS if has_peak else 2


def number_place(phase: PhaseFunction, number: Tensor) -> Tensor:
    """`number` from -1 to 1 in polynomials: of a weight, or of g by its artanh, 0 and less as 0."""
    if not is_scaled(phase):
        return 2 * number - 1
    g = torch.where(number > 0, number, torch.zeros_like(number))
    g = torch.where(g < STEEPEST, g, torch.full_like(g, STEEPEST))
    return torch.atanh(g) / (math.atanh(STEEPEST) / 2) - 1


def number_table(
    phase: PhaseFunction, make: Callable[..., Tensor], has_peak: bool, sign: int, *arguments: int
) -> Tensor:
    """Coefficients over the number of the tables that `make` has of `phase` and `arguments`.

    They are [C, steps + 1, 2, powers K], of tables [C, steps + 1, 2, K], with so many powers as
    `count_powers` says. `sign` is that of g.
    """
    assert phase.cells is not None
    numbers = _fitted_numbers(
        is_scaled(phase), count_powers(phase, has_peak), sign, phase.cells.device
    )
    return _fit(phase.with_cells(numbers), numbers, make, *arguments)


@functools.cache
@torch.inference_mode(False)
def _fitted_numbers(is_g: bool, powers: int, sign: int, device: torch.device) -> Tensor:
    """The numbers [`powers`] at which polynomials are fitted."""
    places, *_ = extrema(powers)
    half = (places + 1) / 2
    return (sign * torch.tanh(math.atanh(STEEPEST) * half) if is_g else half).to(device)


@remember
def _fit(
    phase: PhaseFunction, numbers: Tensor, make: Callable[..., Tensor], *arguments: int
) -> Tensor:
    """As `number_table`, of a `phase` with all `numbers` at which polynomials are fitted."""
    # one after the other: weak peaks have short series
    phases = [phase.with_cells(number) for number in numbers]
    tables = torch.stack([make(at_number, *arguments) for at_number in phases])
    if is_scaled(phase):
        # S over p, where p is summed as S is
        moments = (at_number.moments(at_number.length()).double() for at_number in phases)
        sums = torch.stack([tabulate_series(series_weights(chi)[..., None]) for chi in moments])
        p, d_p = sums.unbind(-2)
        values, slopes = tables.unbind(-2)
        ratio = values / p
        tables = torch.stack([ratio, (slopes - ratio * d_p) / p], -2)
    *_, to_series = extrema(len(phases))
    coefficients = torch.tensordot(to_series.to(tables), tables, 1)
    return coefficients.movedim(0, -2).flatten(-2).contiguous()


def tabulate_series(weights: Tensor) -> Tensor:
    """Sums over l of `weights` [C, count, K] times P_l as a table [C, steps + 1, 2, K]."""
    curves = legendre_at_even_angles(STEPS, weights.shape[1])
    return torch.stack([rows.to(weights) @ weights for rows in curves], 2)


def peak_moments(phase: PhaseFunction, degree: int, sign: int = 1) -> tuple[Tensor, Tensor]:
    """All moments f r_l of a peak, and all r_l, which are 1 up to `degree` (E8.5).

    `sign` is as of `PhaseFunction.peak_tail`.
    """
    tail = phase.peak_tail(degree, phase.length() - degree - 1, sign).double()
    fraction = tail[:, :1]
    low = fraction.expand(-1, degree + 1, *tail.shape[2:])
    # Without a peak r_l beyond `degree` does not matter.
    spread = tail / torch.where(fraction > 0, fraction, 1)
    return torch.cat([low, tail], 1), torch.cat([torch.ones_like(low), spread], 1)


def peaked_series(phase: PhaseFunction, degree: int, depth: Tensor) -> Tensor:
    """(2 l + 1) times the moments s_l of S at `depth` [C or 1, ..., 1], [C, ..., count] (E8.6)."""
    moments = phase.moments(phase.length()).double(), *peak_moments(phase, degree)
    chi, peak, spread = (
        numbers.movedim(1, -1).unflatten(0, (-1, *[1] * (depth.ndim - numbers.ndim)))
        for numbers in moments
    )
    # exp(-x (1 - r)) phi(r x), which is exp(-x) phi(-r x) for r < 0.
    forward, size = spread.clamp(min=0), spread.abs()
    turned = torch.exp((forward - 1) * depth) * decay_mean(size * depth)
    return series_weights(chi - peak + peak * turned)


@remember
def _plain_table(phase: PhaseFunction) -> Tensor:
    cosines = even_angles(STEPS).to(phase.moments(1).device).cos()
    return with_slopes(phase.map(Tensor.double).value(cosines))


@remember
def _peak_table(phase: PhaseFunction, degree: int) -> Tensor:
    """The polynomials of S, [C, steps + 1, 2, COEFFICIENTS], of a phase function."""
    places, inverse, _ = (array.to(phase.moments(1).device) for array in extrema(COEFFICIENTS))
    # At the depths of the fit, and from these to coefficients: [C, count, COEFFICIENTS].
    series = peaked_series(phase.map(Tensor.double), degree, depth_at(places)[None, :, None])
    return tabulate_series((inverse @ series).mT)
