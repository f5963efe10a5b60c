"""What ranks exchange of fields in slabs, differentiable.

The objective is a sum over ranks. So every adjoint is the transpose of the exchange as a whole:
what one rank has lent to others is added up by those others' cotangents.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.grid import Grid
from ddrecon.numerics.autodiff import differentiate_once
from ddrecon.ranks import (
    own_rank,
    rank_count,
    sum_over_ranks,
    swap_with_neighbors,
    trade_with_ranks,
)
from ddrecon.slabs.slab import Slab

Linear = Callable[[Tensor], Tensor]


class _Exchange(torch.autograd.Function):
    """`give(tensor)`, a linear exchange, whose transpose is `back`."""

    @staticmethod
    def forward(give: Linear, back: Linear, tensor: Tensor) -> Tensor:
        return give(tensor)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.give, ctx.back = inputs[:2]

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, bar: Tensor) -> tuple[None, None, Tensor]:
        return None, None, ctx.back(bar)

    @staticmethod
    def jvp(ctx: Any, _give: None, _back: None, change: Tensor) -> Any:
        return ctx.give(change)


def _exchange(give: Linear, back: Linear, tensor: Tensor) -> Tensor:
    result: Tensor = _Exchange.apply(give, back, tensor)
    return result


def add_halo(own: Tensor, slab: Slab) -> Tensor:
    """`own` cells [..., z, y, x] with those that neighbors of `slab` have beside them."""
    axis, (below, above) = slab.axis - 3, slab.halo

    def give(own: Tensor) -> Tensor:
        before, after = swap_ends(own, axis, slab.halo)
        return torch.cat([part for part in (before, own, after) if part is not None], axis)

    def back(field_bar: Tensor) -> Tensor:
        own_bar, (before, after) = (
            slab.own(field_bar).clone(),
            swap_ends(field_bar, axis, slab.halo),
        )
        if before is not None:
            own_bar.narrow(axis, 0, below).add_(before)
        if after is not None:
            own_bar.narrow(axis, slab.size - above, above).add_(after)
        return own_bar

    return _exchange(give, back, own)


def gather_slabs(field: Tensor, grid: Grid) -> Tensor:
    """All cells [..., z, y, x] of the whole of which `grid` is a slab, and `field` a part.

    `field` itself where `grid` is the whole.
    """
    return gather_own(grid.own(field), grid) if isinstance(grid, Slab) else field


def gather_own(own: Tensor, slab: Slab) -> Tensor:
    """The same from the `own` layers of a slab, of any shape across its axis."""
    axis, begin = slab.axis - 3, slab.cuts[slab.rank]
    return _exchange(
        lambda own: join_parts(own, axis, slab.sizes),
        lambda whole_bar: _sum(whole_bar).narrow(axis, begin, slab.size),
        own,
    )


def sum_slabs(part: Tensor) -> Tensor:
    """The sum over ranks of `part`, any shape, differentiable."""
    return _exchange(_sum, _sum, part)


def sum_before(part: Tensor, is_upwards: Tensor) -> Tensor:
    """The sum of `part` [K, R] over the ranks before this one, differentiable.

    Those are the ranks below where ray R `is_upwards`, else the ranks above. Each rank adds up some
    of the rays for all ranks: so bytes do not grow with their number.
    """
    ranks, (fields, rays) = rank_count(), part.shape
    share = -(-rays // ranks)

    def of_all(values: Tensor) -> Tensor:
        return pad(values, (0, share * ranks - rays)).unflatten(-1, (ranks, share))

    def add_up(part: Tensor, is_upwards: Tensor) -> Tensor:
        parts = trade_with_ranks(of_all(part).transpose(0, 1))
        nothing = torch.zeros_like(parts[:1])
        up = torch.cat([nothing, parts[:-1]]).cumsum(0)
        down = torch.cat([nothing, parts[1:].flip(0)]).cumsum(0).flip(0)
        before = trade_with_ranks(torch.where(of_all(is_upwards)[own_rank()], up, down))
        return before.transpose(0, 1).reshape(fields, -1)[:, :rays]

    # Who are before one rank have it after them.
    return _exchange(
        lambda part: add_up(part, is_upwards), lambda bar: add_up(bar, ~is_upwards), part
    )


def swap_layers(below: Tensor, above: Tensor) -> tuple[Tensor, Tensor]:
    """What the ranks below and above have for this one, which has `below` and `above` for them.

    All are of one shape; zero where no rank is. Differentiable.
    """

    def swap(both: Tensor) -> Tensor:
        below, above = both
        got = swap_with_neighbors(
            below if own_rank() > 0 else None, above if own_rank() + 1 < rank_count() else None
        )
        return torch.stack([torch.zeros_like(below) if one is None else one for one in got])

    from_below, from_above = _exchange(swap, swap, torch.stack([below, above]))
    return from_below, from_above


def swap_ends(
    field: Tensor, axis: int, layers: tuple[int, int]
) -> tuple[Tensor | None, Tensor | None]:
    """What the ranks below and above have for this one, who get the ends of `field` along `axis`.

    That are its first and its last `layers`, as many as those have for it; 0 where no rank is.
    """
    below, above = layers
    return swap_with_neighbors(
        field.narrow(axis, 0, below) if below else None,
        field.narrow(axis, field.shape[axis] - above, above) if above else None,
    )


def join_parts(own: Tensor, axis: int, sizes: list[int]) -> Tensor:
    """All ranks' `own` parts one after the other along `axis` < 0, of `sizes`; no derivatives."""
    missing = max(sizes) - own.shape[axis]
    padded = pad(own, (0, 0) * (-axis - 1) + (0, missing))
    parts = trade_with_ranks(padded.expand(rank_count(), *padded.shape))
    return torch.cat([part.narrow(axis, 0, n) for part, n in zip(parts, sizes, strict=True)], axis)


def _sum(part: Tensor) -> Tensor:
    """The sum over ranks, without derivatives; it is its own transpose."""
    return sum_over_ranks([part])[0]
