"""A phase function that differs from cell to cell, as view rays see light of beams scattered by it.

The number that differs is interpolated to the nodes of rays, as density is. Without a forward peak
the phase function is evaluated there. With one, S of E8.7 is looked up by that number and by the
angle: its polynomials are kept at even steps of the number, the rungs (docs/theory.md E8.9), for
each color whose phase function has other numbers besides.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.medium.coefficients import Medium
from ddrecon.medium.phase import HenyeyGreenstein, PhaseFunction, PhaseKind, remember_of_phase
from ddrecon.medium.phase_blend import Mixture
from ddrecon.medium.phase_peak import in_double, peak_table
from ddrecon.medium.remaining import turned_table
from ddrecon.numerics.angle_table import STEPS, angle_of, look_up, look_up_between, with_slopes
from ddrecon.numerics.chebyshev import evaluate_positive
from ddrecon.numerics.legendre import even_angles

STEEP_STEP, STEEP_STEPS = 0.05, 54
"""Of artanh g, so many from 0 on, to 0.991: a peak, 2 / (1 - g)^2 high, is cubic in it to 4e-6."""
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
        """p [N, C, R] at `cosine` [R] or [N, R]."""
        number = self.number.movedim(1, 0)
        found = self.phase.with_cells(number).value(cosine.expand(number.shape[1:]))
        return found.movedim(0, 1)

    def along(self, depth: Tensor, cosine: Tensor) -> Tensor:
        """S at `depth` [N, C, R] along R rays, each with one `cosine` [R]."""
        return self.at_angles(depth, angle_of(cosine).expand(len(depth), -1))

    def at_angles(self, depth: Tensor | None, angle: Tensor) -> Tensor:
        """S, or p where `depth` is None, [N, C, R] at `depth` [N, C, R] and `angle` [N, R].

        Where g is not positive there is no peak, and S is p.
        """
        kind, number = self.phase.kind, self.number.movedim(1, 0)
        if depth is None and not is_steep(kind):
            other, change = look_up(end_table(self.phase).to(number), angle).unbind(-1)
            return (other + number * change).movedim(0, 1)
        plain = self.value(angle.cos().to(number))
        if depth is None:
            return plain
        tables = peak_tables(self.phase, self.degree).to(number)
        place = _place(kind, number.clamp(min=0) if is_steep(kind) else number, 0)
        coefficients = _look_up(tables, place, angle)
        seen = evaluate_positive(coefficients.permute(3, 1, 0, 2), depth)
        return torch.where(self.number > 0, seen, plain) if is_steep(kind) else seen


def is_steep(kind: PhaseKind) -> bool:
    """Whether the number is g, and rungs are even in artanh g; else p is linear in it, a weight."""
    return kind is HenyeyGreenstein


def count_tables(phase: PhaseFunction) -> int:
    """How many colors have other numbers besides that of cells; 1 where they share them."""
    return max(part.colors for part in phase.parts) if isinstance(phase, Mixture) else 1


def peak_tables(phase: PhaseFunction, degree: int) -> Tensor:
    """Polynomials of S at all rungs, and slopes between, [1 or 3, n, 2, steps + 1, 2, K]."""
    return _tables(_at_rungs(phase, 0), peak_table, degree)


def at_ends(phase: PhaseFunction, cosine: Tensor) -> tuple[Tensor, Tensor]:
    """p where a weight is 0, and its change until that is 1: [1 or 3, *cosine.shape] each."""
    none, whole = (phase.with_cells(cosine.new_tensor(end)).value(cosine) for end in (0.0, 1.0))
    return none, whole - none


def end_table(phase: PhaseFunction) -> Tensor:
    """The two of `at_ends` over the angle, as `look_up` has them, [1 or 3, steps + 1, 2, 2]."""
    return _end_table(_at_rungs(phase, 0))


@remember_of_phase
def _end_table(phase: PhaseFunction) -> Tensor:
    cosines = even_angles(STEPS).to(phase.numbers[0].device).cos()
    return torch.cat([with_slopes(end) for end in at_ends(in_double(phase), cosines)], -1)


def turned_in_cells(medium: Medium, turns: int, angle: Tensor) -> Tensor:
    """How light turned so often scatters by `angle` [z, y, x] in cells, [C, z, y, x] (E8.12)."""
    phase, kind = medium.seen.phase, medium.seen.phase.kind
    assert phase.cells is not None
    backward = STEEP_STEPS
    rungs = _at_rungs(phase, backward)
    tables = _tables(rungs, turned_table, medium.seen.degree, turns)
    return _look_up(tables.to(phase.cells), _place(kind, phase.cells, backward), angle)[..., 0]


def _at_rungs(phase: PhaseFunction, backward: int) -> PhaseFunction:
    """`phase` at the numbers at which tables are kept; of g so many of them are `backward`."""
    return phase.with_cells(_rungs(phase.kind, backward, phase.numbers[0].device))


def _look_up(tables: Tensor, place: Tensor, angle: Tensor) -> Tensor:
    """Values [C, ..., K] of the `tables` [1 or C, ...] at `place` [1 or C, ...] and `angle` [...].

    Each is as `look_up_between` has it; `angle` is the same for all colors.
    """
    colors, shape = (
        max(len(tables), len(place)),
        torch.broadcast_shapes(place[0].shape, angle.shape),
    )
    place, angle = place.expand(colors, *shape), angle.expand(shape).double()
    if len(tables) == 1:
        return look_up_between(tables[0], place, angle.expand(place.shape))
    return torch.stack([look_up_between(*each, angle) for each in zip(tables, place, strict=True)])


def _place(kind: PhaseKind, number: Tensor, backward: int) -> Tensor:
    """Between which of the rungs `number` is, counted from the first."""
    if not is_steep(kind):
        return number * EVEN_STEPS
    return torch.atanh(number) / STEEP_STEP + backward


@functools.cache
@torch.inference_mode(False)
def _rungs(kind: PhaseKind, backward: int, device: torch.device) -> Tensor:
    """The numbers at which tables are kept, [n]: even steps of artanh g, or of a weight."""
    if is_steep(kind):
        steps = torch.arange(-backward, STEEP_STEPS + 1, dtype=torch.float64, device=device)
        return torch.tanh(STEEP_STEP * steps)
    return torch.arange(EVEN_STEPS + 1, dtype=torch.float64, device=device) / EVEN_STEPS


@remember_of_phase
def _tables(phase: PhaseFunction, make: Callable[..., Tensor], *arguments: int) -> Tensor:
    """What tables `make` has at all rungs, and their slopes, [1 or 3, n, 2, steps + 1, 2, K]."""
    # one after the other: weak peaks have short series
    return _with_slopes([make(phase.with_cells(rung), *arguments) for rung in phase.numbers[-1]])


def _with_slopes(tables: Sequence[Tensor]) -> Tensor:
    """Tables [C, steps + 1, 2, K] of all rungs, and their slopes from one to the next.

    They are [C, n, 2, steps + 1, 2, K].
    """
    values = torch.stack(list(tables))
    wide = _extended(_extended(values))
    near, far = wide[3:-1] - wide[1:-3], wide[4:] - wide[:-4]
    return torch.stack([values, (8 * near - far) / 12], 1).movedim(2, 0).contiguous()


def _extended(tables: Tensor) -> Tensor:
    """`tables` with one more at both ends, where the polynomial through the nearest six leads."""
    ahead = tables.new_tensor([6, -15, 20, -15, 6, -1])
    first, last = (torch.tensordot(ahead, t[:6], 1) for t in (tables, tables.flip(0)))
    return torch.cat([first[None], tables, last[None]])
