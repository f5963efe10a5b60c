"""What replaces the phase function for a beam seen along a view ray, whose peak was scaled out.

Light that the forward peak alone has scattered, often or once, is still on its way; at a depth x of
the peak it has spread (docs/theory.md E8.7, E8.6). Along a ray only x changes: the function is a
polynomial in (x - s) / (x + s), whose coefficients are kept over the angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.medium.phase import PhaseFunction, henyey_greenstein, remember_of_phase
from ddrecon.medium.phase_cells import count_powers, is_scaled, number_place, number_table
from ddrecon.numerics.angle_table import STEPS, angle_of, look_up, with_slopes
from ddrecon.numerics.chebyshev import (
    COEFFICIENTS,
    depth_at,
    depth_place,
    evaluate,
    extrema,
    sum_series,
)
from ddrecon.numerics.decay import decay_mean
from ddrecon.numerics.legendre import even_angles, legendre_at_even_angles, series_weights


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
        kind = self.phase.kind
        value = sum_series(seen, number_place(kind, self.number))
        value = value.clamp(min=0) if has_peak else value
        return henyey_greenstein(cosine, self.number) * value if is_scaled(kind) else value

    def table(self, has_peak: bool) -> Tensor:
        """Of S its coefficients, [C, steps + 1, 2, K], or without a peak of p the values.

        At even angles, with slopes by the angle (`numerics.angle_table`), in double precision. Of a
        phase function that differs from cell to cell K is as `number_table` has it.
        """
        make, degree = (peak_table, (self.degree,)) if has_peak else (_plain_table, ())
        if self.phase.cells is None:
            return make(self.phase, *degree)
        return number_table(self.phase, make, count_powers(self.phase, has_peak), 1, *degree)


def peaked_series(phase: PhaseFunction, degree: int, depth: Tensor) -> Tensor:
    """(2 l + 1) times the moments s_l of S at `depth` [C or 1, ..., 1], [C, ..., count] (E8.6)."""
    count = phase.length()
    chi = phase.moments(count).double()
    tail = phase.peak_tail(degree, count - degree - 1).double()
    peak = torch.cat([tail[:, :1].expand_as(chi[:, : degree + 1]), tail], 1)
    # r_l, at most 1; without a peak it does not matter.
    spread = peak / torch.where(tail[:, :1] > 0, tail[:, :1], 1)
    if chi.ndim == 2:
        shape = (-1, *[1] * (depth.ndim - 2), count)
        chi, peak, spread = (each.reshape(shape) for each in (chi, peak, spread))
    else:
        chi, peak, spread = (each[..., 0].movedim(1, -1) for each in (chi, peak, spread))
    # exp(-x (1 - r)) phi(r x), which is exp(-x) phi(-r x) for r < 0.
    forward, size = spread.clamp(min=0), spread.abs()
    turned = torch.exp((forward - 1) * depth) * decay_mean(size * depth)
    return series_weights(chi - peak + peak * turned)


def in_double(phase: PhaseFunction) -> PhaseFunction:
    """`phase` in double precision."""
    return phase.kind(*(each.double() for each in phase.numbers))


@remember_of_phase
def _plain_table(phase: PhaseFunction) -> Tensor:
    cosines = even_angles(STEPS).to(phase.numbers[0].device).cos()
    return with_slopes(in_double(phase).value(cosines))


@remember_of_phase
def peak_table(phase: PhaseFunction, degree: int) -> Tensor:
    """The polynomials of S, [C, steps + 1, 2, COEFFICIENTS], of a phase function."""
    places, inverse, _ = (array.to(phase.numbers[0].device) for array in extrema(COEFFICIENTS))
    # At the depths of the fit, and from these to coefficients: [C, count, COEFFICIENTS].
    series = peaked_series(in_double(phase), degree, depth_at(places)[None, :, None])
    coefficients = (inverse @ series).mT
    curves = legendre_at_even_angles(STEPS, coefficients.shape[1])
    return torch.stack([rows.to(coefficients) @ coefficients for rows in curves], 2)
