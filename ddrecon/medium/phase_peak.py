"""What replaces the phase function for a beam seen along a view ray, whose peak was scaled out.

Light that the forward peak alone has scattered, often or once, is still on its way; at a depth x of
the peak it has spread (docs/theory.md E8.7, E8.6). Along a ray only x changes: the function is a
polynomial in (x - s) / (x + s), whose coefficients are kept over the angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.medium.phase import PhaseFunction, remember_of_phase
from ddrecon.numerics.angle_table import STEPS, angle_of, look_up, with_slopes
from ddrecon.numerics.chebyshev import evaluate_positive, extrema
from ddrecon.numerics.decay import decay_mean
from ddrecon.numerics.legendre import even_angles, legendre_at_even_angles, series_weights


@dataclass(frozen=True, eq=False)
class SeenPhase:
    """A phase function as view rays see light of beams scattered by it.

    `phase`: the function; `degree`: light is known to this degree in angle, and peaks beyond it
    count as not scattered.
    """

    phase: PhaseFunction
    degree: int

    @property
    def colors(self) -> int:
        """How many colors have a phase function of their own: 1 where all share one."""
        return self.phase.colors

    def value(self, cosine: Tensor) -> Tensor:
        """p, [C, *cosine.shape]: what is scattered where no peak was scaled out."""
        return self.phase.value(cosine)

    def along(self, depth: Tensor, cosine: Tensor) -> Tensor:
        """S at `depth` [N, C, R] along R rays, each with one `cosine` [R]."""
        return evaluate_positive(self.polynomials(cosine)[:, None], depth)

    def polynomials(self, cosine: Tensor) -> Tensor:
        """Coefficients [COEFFICIENTS, C, R] of S along rays, each with one `cosine` [R]."""
        found = look_up(self.table(has_peak=True).to(cosine.dtype), angle_of(cosine))
        return found.permute(2, 0, 1)

    def at_angles(self, depth: Tensor | None, angle: Tensor) -> Tensor:
        """S, or p where `depth` is None, [N, C, R] at `depth` [N, C, R] and `angle` [N, R]."""
        found = look_up(self.table(depth is not None).to(angle.dtype), angle.double())
        if depth is None:
            return found[..., 0].movedim(0, 1)
        return evaluate_positive(found.permute(3, 1, 0, 2), depth)

    def table(self, has_peak: bool) -> Tensor:
        """Of S its polynomials, [C, steps + 1, 2, COEFFICIENTS], or of p the values, [..., 1].

        At even angles, with slopes by the angle (`numerics.angle_table`), in double precision.
        """
        return peak_table(self.phase, self.degree) if has_peak else _plain_table(self.phase)


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
    depths, inverse = (each.to(phase.numbers[0].device) for each in extrema())
    # At the depths of the fit, and from these to coefficients: [C, count, COEFFICIENTS].
    series = peaked_series(in_double(phase), degree, depths[None, :, None])
    coefficients = (inverse @ series).mT
    curves = legendre_at_even_angles(STEPS, coefficients.shape[1])
    return torch.stack([rows.to(coefficients) @ coefficients for rows in curves], 2)
