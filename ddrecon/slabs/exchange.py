"""What ranks exchange of fields in slabs, differentiable: E40.

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
    gather_from_ranks,
    own_rank,
    rank_count,
    sum_over_ranks,
    swap_with_neighbors,
    trade_with_ranks,
)
from ddrecon.slabs.slab import Slab


def add_halo(own: Tensor, slab: Slab) -> Tensor:
    """`own` cells [..., z, y, x] with those that neighbors of `slab` have beside them (E40)."""
    field: Tensor = _Exchange.apply(
        lambda own: with_halo(own, slab), lambda field_bar: return_halo(field_bar, slab), own
    )
    return field


def gather_slabs(field: Tensor, grid: Grid) -> Tensor:
    """All cells [..., z, y, x] of the whole of which `grid` is a slab, and `field` a part (E40).

    `field` itself where `grid` is the whole.
    """
    if not isinstance(grid, Slab):
        return field
    return gather_own(grid.own(field), grid)


def gather_own(own: Tensor, slab: Slab) -> Tensor:
    """The same from the `own` layers of a slab, of any shape across its axis."""
    return _gather(own, slab.axis - 3, slab.sizes, slab.rank)


def sum_slabs(part: Tensor) -> Tensor:
    """The sum over ranks of `part`, any shape, differentiable (E40)."""
    total: Tensor = _Exchange.apply(_sum, _sum, part)
    return total


def sum_before(part: Tensor, is_upwards: Tensor) -> Tensor:
    """The sum of `part` [K, R] over the ranks before this one, differentiable (E40).

    Those are the ranks below where ray R `is_upwards`, else the ranks above.
    """
    total: Tensor = _Exchange.apply(
        lambda part: _sum_before(part, is_upwards),
        # Who are before one rank have it after them.
        lambda total_bar: _sum_before(total_bar, ~is_upwards),
        part,
    )
    return total


def swap_layers(below: Tensor, above: Tensor) -> tuple[Tensor, Tensor]:
    """What the ranks below and above have for this one, which has `below` and `above` for them.

    All are of one shape; zero where no rank is. Differentiable (E40).
    """
    layers: tuple[Tensor, Tensor] = _Exchange.apply(_swap, _swap, below, above)
    return layers


def renew_halo(field: Tensor, slab: Slab) -> Tensor:
    """`field` [..., z, y, x] of `slab` with its neighbors' cells as they have them (E40)."""
    return add_halo(slab.own(field), slab)


def join_parts(own: Tensor, axis: int, sizes: list[int]) -> Tensor:
    """All ranks' `own` parts one after the other along `axis` < 0, of `sizes`; no derivatives."""
    most = max(sizes)
    missing = most - own.shape[axis]
    parts = gather_from_ranks(pad(own, (0, 0) * (-axis - 1) + (0, missing)))
    return torch.cat([part.narrow(axis, 0, n) for part, n in zip(parts, sizes, strict=True)], axis)


class _Exchange(torch.autograd.Function):
    """`give(*tensors)`, one or several: a linear exchange, whose transpose is `back`."""

    @staticmethod
    def forward(give: Callable[..., Any], back: Callable[..., Any], *tensors: Tensor) -> Any:
        return give(*tensors)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.give, ctx.back = inputs[:2]

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor | None, ...]:
        back = ctx.back(*bars)
        return None, None, *(back if isinstance(back, tuple) else (back,))

    @staticmethod
    def jvp(ctx: Any, _give: None, _back: None, *changes: Tensor) -> Any:
        return ctx.give(*changes)


def return_halo(field_bar: Tensor, slab: Slab) -> Tensor:
    """The transpose of `with_halo`: own cells' cotangents, with those that neighbors found."""
    axis, (below, above), size = slab.axis - 3, slab.halo, slab.size
    own_bar = slab.own(field_bar).clone()
    lent = swap_with_neighbors(
        field_bar.narrow(axis, 0, below) if below else None,
        field_bar.narrow(axis, below + size, above) if above else None,
    )
    if lent[0] is not None:
        own_bar.narrow(axis, 0, below).add_(lent[0])
    if lent[1] is not None:
        own_bar.narrow(axis, size - above, above).add_(lent[1])
    return own_bar


def with_halo(own: Tensor, slab: Slab) -> Tensor:
    """`own` cells [..., z, y, x] with those of neighbors, without derivatives."""
    axis, (below, above) = slab.axis - 3, slab.halo
    got = swap_with_neighbors(
        own.narrow(axis, 0, below) if below else None,
        own.narrow(axis, own.shape[axis] - above, above) if above else None,
    )
    return torch.cat([part for part in (got[0], own, got[1]) if part is not None], axis)


def _gather(own: Tensor, axis: int, sizes: list[int], rank: int) -> Tensor:
    """All ranks' `own` parts along `axis` < 0, of `sizes`; this is that of `rank`."""
    begin, size = sum(sizes[:rank]), sizes[rank]
    whole: Tensor = _Exchange.apply(
        lambda own: join_parts(own, axis, sizes),
        lambda whole_bar: _sum(whole_bar).narrow(axis, begin, size),
        own,
    )
    return whole


def _sum(part: Tensor) -> Tensor:
    """The sum over ranks, without derivatives; it is its own transpose."""
    return sum_over_ranks([part])[0]


def _sum_before(part: Tensor, is_upwards: Tensor) -> Tensor:
    """What `sum_before` returns, without derivatives.

    Each rank adds up some of the rays for all ranks: so bytes do not grow with their number.
    """
    ranks, (fields, rays) = rank_count(), part.shape
    share = -(-rays // ranks)

    def of_all(values: Tensor) -> Tensor:
        return pad(values, (0, share * ranks - rays)).unflatten(-1, (ranks, share))

    parts = trade_with_ranks(of_all(part).transpose(0, 1))
    nothing = torch.zeros_like(parts[:1])
    up = torch.cat([nothing, parts[:-1]]).cumsum(0)
    down = torch.cat([nothing, parts[1:].flip(0)]).cumsum(0).flip(0)
    before = trade_with_ranks(torch.where(of_all(is_upwards)[own_rank()], up, down))
    return before.transpose(0, 1).reshape(fields, -1)[:, :rays]


def _swap(below: Tensor, above: Tensor) -> tuple[Tensor, Tensor]:
    """What `swap_layers` returns, without derivatives; it is its own transpose."""
    got = swap_with_neighbors(
        below if own_rank() > 0 else None, above if own_rank() + 1 < rank_count() else None
    )
    from_below, from_above = (torch.zeros_like(below) if one is None else one for one in got)
    return from_below, from_above
