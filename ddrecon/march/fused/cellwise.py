"""What kernels are given of a phase function that differs from cell to cell (E36).

A node holds the number that differs. How p depends on it is the layout's `form`:

- `linear`: a weight, without a forward peak. p is `at_ends[0] + weight at_ends[1]`.
- `even`: a weight, with one. E13 by tables at even steps of the weight, the rungs.
- `steep`: g. Where it is positive, and there is a forward peak, by tables at even steps of
  artanh g; else p by its formula.

Kernels know nothing else of a phase function than the number and these tables, of which each color
may have its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.march.emission import Emission
from ddrecon.medium.phase import PhaseKind
from ddrecon.medium.phase_cells import (
    at_ends,
    end_table,
    is_steep,
    peak_tables,
)
from ddrecon.numerics.angle_table import STEPS, angle_of
from ddrecon.numerics.remember import remember


def form_of(emission: Emission) -> str | None:
    """How p depends on the number of the cell; None where it is the same everywhere."""
    phase = emission.seen.phase
    if phase.cells is None:
        return None
    if is_steep(phase.kind):
        return "steep"
    return "linear" if emission.peak is None else "even"


def find_along_rays(cosine: Tensor, form: str, kind: PhaseKind, others: Sequence[Tensor]) -> Tensor:
    """What rays are given of p for a beam seen at `cosine` [R]: `Layout.ray_terms` rows [., R].

    Both of `at_ends` for each color, of the phase function `kind` with its `others` (`others_of`);
    or the cosine, and between which angles of tables it is: the first of them, and the part of the
    way to the second.
    """
    if form == "linear":
        ends = at_ends(kind(*others, cosine.new_zeros(())), cosine)
        return torch.stack(ends, 1).flatten(0, 1)
    place = angle_of(cosine) * (STEPS / math.pi)
    first = place.detach().long().clamp(0, STEPS - 1)
    return torch.stack([cosine, first.to(cosine), (place - first).to(cosine)])


def table_of_cells(emission: Emission) -> Tensor:
    """The tables that kernels read, [rows, terms]: of `linear` those of `at_ends` by angle.

    Of others with a forward peak, by color, rung and angle; and a row more, as kernels read terms
    of several rows at once. The rest have no rows.
    """
    phase, like = emission.seen.phase, emission.diffuse
    if form_of(emission) == "linear":
        return end_table(phase).to(like).flatten(0, 2)
    if emission.peak is None:
        return like.new_empty(0, 1)
    return _flatten(peak_tables(phase, emission.seen.degree), like.dtype)


@remember
def _flatten(tables: Tensor, dtype: torch.dtype) -> Tensor:
    rows = tables.to(dtype).flatten(0, 4)
    return torch.cat([rows, rows.new_zeros(1, rows.shape[1])])
