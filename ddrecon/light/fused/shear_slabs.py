"""The mass that a beam passes in slabs, by the kernels of one process on parts of a grid (E42).

What lies before a slab comes to it as sums along rays. `light.shear_slabs` is the definition.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.grid import Grid
from ddrecon.kernels.dual import interleaved_tangent_of, pair
from ddrecon.light.fused.shear import Shear, Sum, shear_kernels
from ddrecon.light.shear_slabs import Part, SlabRays, counted_parts, own_parts
from ddrecon.numerics.slicing import Slicing
from ddrecon.ranks import gather_from_ranks, rank_count, sum_over_ranks
from ddrecon.slabs.exchange import return_halo, with_halo
from ddrecon.slabs.slab import Slab


class PartShear(Shear):
    """How a beam crosses a `part` of a slab, whose cells are laid out with its empty slices."""

    def __init__(self, slab: Slab, slicing: Slicing, part: Part):
        self.slab, self.part, rows, columns = slab, part, *part.shear.slope.tolist()
        ends = (part.after, part.added) if slicing.is_reversed else (part.added, part.after)
        self.ends = ends if slicing.axis == slab.axis else (0, 0)
        shape = list(slab.shape)
        shape[slab.axis] = part.end - part.begin + sum(self.ends)
        grid = Grid((shape[0], shape[1], shape[2]), slab.lower, slab.upper)
        super().__init__(grid, slicing, (rows, columns))
        lattice, first = part.shear.lattice, part.shear.first
        self.record |= {
            "rows": lattice[0], "columns": lattice[1], "first_slice": part.shear.begin,
            "first_row": first[0], "first_column": first[1],
        }  # fmt: skip

    def cut(self, field: Tensor) -> Tensor:
        """Its cells of a `field` [K, z, y, x] of the slab, as kernels read them."""
        axis, first = self.slab.axis - 3, self.part.begin - self.slab.first
        own = field.narrow(axis, first, self.part.end - self.part.begin)
        return self.lay(pad(own, (0, 0) * (-axis - 1) + self.ends))

    def own(self, laid: Tensor) -> Tensor:
        """The cells of the part, without empty slices, of what is laid out."""
        count = self.part.end - self.part.begin
        return self.lift(laid).narrow(self.slab.axis - 3, self.ends[0], count)

    def add_to(self, field_bar: Tensor, laid_bar: Tensor) -> None:
        """Adds what is laid out to the part's cells of `field_bar` [K, z, y, x] of the slab."""
        first, count = self.part.begin - self.slab.first, self.part.end - self.part.begin
        field_bar.narrow(self.slab.axis - 3, first, count).add_(self.own(laid_bar))


@dataclass(frozen=True)
class SlabShear:
    """How a beam of some `slope` (by rows, by columns) crosses the slices of a `slab`.

    It stands for a `Shear`; cells need not be laid out for it.
    """

    slab: Slab
    slicing: Slicing
    slope: tuple[float, float]
    is_upwards: bool
    axis: int = 0

    @cached_property
    def rays(self) -> SlabRays:
        """The rays along the beam."""
        slope = torch.tensor(self.slope, dtype=torch.float64)
        return SlabRays.of(self.slab, self.slicing, slope)

    @cached_property
    def own(self) -> list[PartShear]:
        """The parts of its own cells, in the order of the beam."""
        parts = own_parts(self.rays, self.is_upwards)
        return [PartShear(self.slab, self.slicing, part) for part in parts]

    @cached_property
    def all(self) -> PartShear:
        """The slab with its halo."""
        part = self.rays.part(self.slab.first, self.slab.last)
        return PartShear(self.slab, self.slicing, part)

    def lay(self, cells: Tensor) -> Tensor:
        """`cells` [K, z, y, x]."""
        return cells.contiguous()

    def lift(self, laid: Tensor) -> Tensor:
        """The same."""
        return laid

    def sum(self, laid: Tensor, numbers: Tensor, light: int, has_adjoint: bool = False) -> SlabSum:
        """The mass of a field."""
        return SlabSum(self, laid, numbers, light, has_adjoint)

    def counted(self, like: Tensor) -> Tensor:
        """Which parts of all ranks lie before the slab with its halo, [ranks, 2]."""
        return like.new_tensor(counted_parts(self.slab, rank_count(), self.is_upwards))

    def before(self, sums: list[Tensor]) -> Tensor:
        """Of sums [2, K, rows, columns, ...] on rays of `own`, those before `all` of its rays."""
        lattice = self.rays.whole.lattice
        spread = torch.zeros(2, *sums[0].shape[:2], *lattice, *sums[0].shape[4:]).to(sums[0])
        for to, shear, found in zip(spread, self.own, sums, strict=True):
            _on(to, shear.part).copy_(found)
        parts = torch.stack(gather_from_ranks(spread))
        before = torch.einsum("rp,rp...->...", self.counted(parts), parts)
        return _on(before, self.all.part).contiguous()

    def sums_bar(self, before_bar: Tensor) -> list[Tensor]:
        """The transpose of `before`."""
        whole = before_bar.new_zeros(*before_bar.shape[:2], *self.rays.whole.lattice)
        _on(whole, self.all.part).copy_(before_bar)
        parts = torch.einsum("rp,...->rp...", self.counted(whole), whole)
        own = sum_over_ranks([parts])[0][self.slab.rank]
        return [_on(bar, shear.part).contiguous() for bar, shear in zip(own, self.own, strict=True)]

    def follow_tangent(self, field: Tensor, d_field: Tensor, numbers: Tensor, light: int) -> Tensor:
        """The mass up to where a beam enters cells and its change, [K, z, y, x, 2]."""
        kernels = shear_kernels(field.element_size() * 8)
        rays_kernel, cells_kernel = map(interleaved_tangent_of, (kernels.rays, kernels.cells))

        def given_of(shear: PartShear) -> dict[str, object]:
            laid = pair(shear.cut(field), shear.cut(d_field))
            given = {"light": light, "numbers": numbers, "field": laid, "channels": len(laid)}
            return shear.record | given

        sums = []
        for shear in self.own:
            lattice = shear.part.shear.lattice
            after = field.new_empty(2, len(field), *lattice, 2)
            rays_kernel.launch(shear.items(field)[0], given_of(shear), {"after": after})
            sums.append(after)
        shear, given = self.all, given_of(self.all)
        laid = given["field"]
        assert isinstance(laid, Tensor)
        made = {"masses": laid.new_empty(2 * len(laid) * shear.window)}
        rays, cells = shear.items(field)
        rays_kernel.launch(rays, given | {"before": self.before(sums)}, made)
        entered = torch.empty_like(laid)
        cells_kernel.launch(cells, given | made, {"entered": entered})
        each = [shear.own(one.contiguous()) for one in entered.unbind(-1)]
        return torch.stack([with_halo(self.slab.own(one), self.slab) for one in each], -1)


class SlabSum:
    """The mass of a `field` of a slab up to where a beam enters each cell; as `Sum` has it."""

    def __init__(
        self, shear: SlabShear, field: Tensor, numbers: Tensor, light: int, has_adjoint: bool
    ):
        self.shear, self.numbers, self.light = shear, numbers, light
        kernels = shear_kernels(field.element_size() * 8)
        self.laid = [own.cut(field) for own in shear.own]
        sums = []
        for own, laid in zip(shear.own, self.laid, strict=True):
            after = field.new_empty(2, len(field), *own.part.shear.lattice)
            kernels.rays.launch(own.items(laid)[0], self._given(own, laid), {"after": after})
            sums.append(after)
        before = shear.before(sums)
        self.sum = Sum(shear.all, shear.all.cut(field), numbers, light, has_adjoint, before)
        self.entered = with_halo(shear.slab.own(shear.all.own(self.sum.entered)), shear.slab)

    def adjoint(self, entered_bar: Tensor, field_bar: Tensor, varies: bool) -> Tensor | None:
        """The cotangent [4] of the beam's numbers, if it `varies`; adds to that of the field.

        To be called once.
        """
        shear, slab = self.shear, self.shear.slab
        # Of the slab's own cells alone.
        whole_bar = torch.zeros_like(entered_bar)
        slab.own(whole_bar).copy_(return_halo(entered_bar, slab))
        laid_bar = torch.zeros_like(self.sum.laid)
        found = [self.sum.adjoint(shear.all.cut(whole_bar), laid_bar, varies)]
        shear.all.add_to(field_bar, laid_bar)
        assert self.sum.before_bar is not None
        sums_bar = shear.sums_bar(self.sum.before_bar)
        for own, laid, after_bar in zip(shear.own, self.laid, sums_bar, strict=True):
            laid_bar = torch.zeros_like(laid)
            found.append(self._return(own, laid, after_bar, laid_bar, varies))
            own.add_to(field_bar, laid_bar)
        numbers = [one for one in found if one is not None]
        return torch.stack(numbers).sum(0) if numbers else None

    def _return(
        self, shear: PartShear, laid: Tensor, after_bar: Tensor, laid_bar: Tensor, varies: bool
    ) -> Tensor | None:
        """The adjoint of the sums along rays through a part."""
        kernels = shear_kernels(laid.element_size() * 8)
        rays, cells = shear.items(laid)
        windows = laid.new_zeros(2, len(laid) * shear.window)
        by_rays, by_field = (
            laid.new_zeros(4 * count * varies, dtype=torch.float64) for count in (rays, cells)
        )
        given = self._given(shear, laid) | {"varies": varies, "after_bar": after_bar}
        made = {"masses": windows[0], "refinements": windows[1], "field_bar": laid_bar}
        made |= {"by_rays": by_rays, "by_field": by_field}
        kernels.rays_adjoint.launch(rays, given, made)
        kernels.field_adjoint.launch(cells, given, made)
        return (
            torch.stack([each.view(-1, 4).sum(0) for each in (by_rays, by_field)]).sum(0)
            if varies
            else None
        )

    def _given(self, shear: PartShear, laid: Tensor) -> dict[str, object]:
        given = {"light": self.light, "numbers": self.numbers, "field": laid}
        return shear.record | given | {"channels": len(laid)}


def _on(sums: Tensor, part: Part) -> Tensor:
    """Of `sums` [2, K, rows, columns, ...] on rays of the whole, those of a `part` (a view)."""
    (row, column), (rows, columns) = part.first, part.shear.lattice
    return sums[:, :, row : row + rows, column : column + columns]
