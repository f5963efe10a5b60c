"""A phase function that differs from cell to cell, as view rays see light of beams scattered by it.

The number that differs is interpolated to the nodes of rays, as density is. Without a forward peak
the phase function is evaluated there. With one, S of E13 is looked up by that number and by the
angle: its polynomials are kept at even steps of the number (docs/theory.md E39).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from ddrecon.medium.phase import HenyeyGreenstein, PhaseFunction
from ddrecon.medium.phase_peak import peak_table
from ddrecon.numerics.angle_table import angle_of, look_up_between
from ddrecon.numerics.chebyshev import evaluate_positive
from ddrecon.numerics.remember import remember

STEEP_STEP, STEEP_STEPS = 0.05, 54
"""Of artanh g, up to g = 0.991: in it a peak, 2 / (1 - g)^2 high, is cubic to 4e-6."""
EVEN_STEPS = 16
"""Of a weight between 0 and 1."""


@dataclass(frozen=True, eq=False)
class SeenNodes:
    """What `SeenPhase` is where the number of `phase` that differs is known at nodes of rays.

    It is [N, C, R]. `degree`: light is known to this degree in angle.
    """

    phase: PhaseFunction
    number: Tensor
    degree: int

    def value(self, cosine: Tensor) -> Tensor:
        """p [N, C, R] at `cosine` [R] or [N, 1, R]."""
        return self.phase.with_cells(self.number).value(cosine)

    def along(self, depth: Tensor, cosine: Tensor) -> Tensor:
        """S at `depth` [N, C, R] along R rays, each with one `cosine` [R]."""
        return self.at_angles(depth, angle_of(cosine).expand(len(depth), -1))

    def at_angles(self, depth: Tensor | None, angle: Tensor) -> Tensor:
        """S, or p where `depth` is None, [N, C, R] at `depth` [N, C, R] and `angle` [N, R].

        Where g is not positive there is no peak, and S is p.
        """
        angle = angle[:, None]
        plain = self.value(angle.cos().to(self.number))
        if depth is None:
            return plain
        rungs = _rungs(isinstance(self.phase, HenyeyGreenstein), self.number.device)
        others = (one for one in fields(self.phase) if one.name != self.phase.CELLWISE)
        numbers = (getattr(self.phase, one.name) for one in others)
        table = _tables(type(self.phase), self.degree, rungs, *numbers).to(self.number)
        place, angle = torch.broadcast_tensors(self._place(), angle)
        coefficients = look_up_between(table, place, angle.double())
        seen = evaluate_positive(coefficients.movedim(-1, 0), depth)
        is_steep = isinstance(self.phase, HenyeyGreenstein)
        return torch.where(self.number > 0, seen, plain) if is_steep else seen

    def _place(self) -> Tensor:
        """Between which of these numbers is that of each node, [N, C, R]."""
        if not isinstance(self.phase, HenyeyGreenstein):
            return self.number * EVEN_STEPS
        return torch.atanh(self.number.clamp(min=0)) / STEEP_STEP


@functools.cache
@torch.inference_mode(False)
def _rungs(is_steep: bool, device: torch.device) -> Tensor:
    """The numbers at which polynomials are kept, [n]."""
    steps = torch.arange((STEEP_STEPS if is_steep else EVEN_STEPS) + 1, dtype=torch.float64)
    numbers = torch.tanh(STEEP_STEP * steps) if is_steep else steps / EVEN_STEPS
    return numbers.to(device)


@remember
def _tables(kind: type[PhaseFunction], degree: int, rungs: Tensor, *numbers: Tensor) -> Tensor:
    """Polynomials at all `rungs`, and their slopes from rung to rung, [n, 2, steps + 1, 2, K].

    `numbers` are the others of the phase function, in front of the one that has the rungs.
    """
    # one after the other: weak peaks have short series
    tables = torch.cat([peak_table(kind, degree, *numbers, rung) for rung in rungs])
    wide = _extended(_extended(tables))
    near, far = wide[3:-1] - wide[1:-3], wide[4:] - wide[:-4]
    return torch.stack([tables, (8 * near - far) / 12], 1)


def _extended(tables: Tensor) -> Tensor:
    """`tables` with one more at both ends, where the polynomial through the nearest six leads."""
    ahead = tables.new_tensor([6, -15, 20, -15, 6, -1])
    first, last = (torch.tensordot(ahead, t[:6], 1) for t in (tables, tables.flip(0)))
    return torch.cat([first[None], tables, last[None]])
