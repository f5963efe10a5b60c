"""The directions of a sweep whose slices lie across z and y; or, with y and x exchanged, across x.

The arrays of one kind of slices, and the launches of kernels on them.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.characteristics import Direction
from ddrecon.diffusion.rounds.fused.kernels import records, sweep_kernels
from ddrecon.diffusion.rounds.fused.rows import MARGIN
from ddrecon.diffusion.rounds.fused.schedule import Item, Schedule, share_items
from ddrecon.diffusion.rounds.fused.surroundings import surround
from ddrecon.diffusion.rounds.fused.turning import turn
from ddrecon.grid import Grid
from ddrecon.kernels.launch import array, launch, thread_count
from ddrecon.kernels.spare import borrow, give_back

Weighted = tuple[tuple[Direction, tuple[float, ...]], ...]
"""Directions, and the weights of their radiance in the moments."""


@dataclass(frozen=True)
class Plan:
    """The directions of a sweep through `grid`; and whether a thread does a cell, not an item."""

    grid: Grid
    weighted: Weighted
    by_cells: bool


@dataclass(frozen=True)
class Swept:
    """What is swept: `numbers` [3, C] as in `records.Given`, fields [K, z, y, x], and moments.

    `scattering` is None where it has the field of extinction; `light` holds the mean, and where it
    has one the flux, [C, z, y, x] each.
    """

    numbers: Tensor
    extinction: Tensor
    scattering: Tensor | None
    light: tuple[Tensor, ...]

    @staticmethod
    def of(numbers: Tensor, extinction: Tensor, scattering: Tensor | None, *light: Tensor) -> Swept:
        return Swept(numbers, extinction, scattering, light)


class Part:
    """One schedule of a sweep; where it `is_turned`, y and x are exchanged in all its arrays."""

    def __init__(self, plan: Plan, schedule: Schedule, swept: Swept, is_turned: bool):
        self.plan, self.schedule, self.swept, self.is_turned = plan, schedule, swept, is_turned
        self.like, self.borrowed = swept.light[0], list[Tensor]()
        self.bits = torch.finfo(self.like.dtype).bits
        self.light = [self.turn(moment) for moment in swept.light]
        self.colors, self.depth, self.height, self.width = self.light[0].shape
        self.rows = max(self.depth, self.height)
        self.stretch = -(-self.width // MARGIN) * MARGIN + 2 * MARGIN
        self.threads = 1 if plan.by_cells else thread_count(self.like)
        # Few directions cross slices across x: sums for each thread would cost more than they.
        self.is_apart = is_turned and self.threads <= self.colors
        self.lanes = self.colors if plan.by_cells else 1
        has_flux, shares_field = len(self.light) > 1, swept.scattering is None
        self.kernels = functools.partial(sweep_kernels, self.bits, has_flux, shares_field)
        fields = (swept.extinction, swept.scattering)
        self.fields, self.occupied = surround(
            [self.turn(field.detach()) for field in fields if field is not None], self.stretch
        )

    def turn(self, cells: Tensor) -> Tensor:
        """`cells` in the order of this part, in memory that is given back with `done`."""
        if not self.is_turned:
            return cells
        turned = turn(cells)
        self.borrowed.append(turned)
        return turned

    def done(self) -> None:
        """Gives back the memory that was computed in; the sums are not in it."""
        give_back(*self.borrowed)
        self.borrowed = []

    def follow(self) -> list[Tensor]:
        """Shares of the moments [M, C, z, y, x] of radiance along the directions."""
        items, bounds, given = self._given(is_kept=False)
        sums = self._sums(items, bounds)
        works = [self._work(given, 2) for _ in sums]
        for work, moments in zip(works, sums, strict=True):
            work.light = self._light(moments)
        if self.plan.by_cells:
            for first in range(0, len(items), self.colors):
                piece = items[first : first + self.colors]
                slices = range(-1, self._slices(piece[0]))
                self._launch_piece(
                    self.kernels(False).follow_cells, first, piece, [given, works[0]], slices
                )
        else:
            self._launch_items(self.kernels(False).follow_items, given, works, [], bounds)
        self.done()
        return self._distinct(sums)

    def transpose(self, bars: Sequence[Tensor], varies_numbers: bool) -> list[list[Tensor]]:
        """Shares of the cotangents of numbers [3, C, rows, x], of moments and of fields."""
        kernels = self.kernels(varies_numbers)
        items, bounds, given = self._given(is_kept=True)
        bars_record = self._light([self.turn(bar) for bar in bars])
        sums, shape = self._sums(items, bounds), self.light[0].shape[1:]
        numbers = self.like.new_zeros(self.threads, 3, self.colors, self.rows, self.width)
        # Sums of fields are by color where colors go side by side.
        channels = [self.colors if self.lanes > 1 else len(field) for field in self.fields]
        fields = [self.like.new_zeros(self.threads, each, *shape) for each in channels]
        works = [self._work(given, 3 + len(self.fields)) for _ in sums]
        for i, work in enumerate(works):
            work.light, work.numbers = self._light(sums[i]), self._array(numbers[i])
            work.extinction, work.scattering = (self._array(fields[j][i]) for j in (0, -1))
            work.extinction_channels, work.scattering_channels = channels[0], channels[-1]
            kept = self.lanes * given.group * self._cells
            work.arriving = self._array(self._borrow(kept))
        if self.plan.by_cells:
            for first in range(0, len(items), self.colors):
                piece = items[first : first + self.colors]
                slices = range(-1, self._slices(piece[0]))
                self._launch_piece(kernels.keep_cells, first, piece, [given, works[0]], slices)
                arguments = [given, works[0], bars_record]
                self._launch_piece(kernels.return_cells, first, piece, arguments, slices[::-1])
        else:
            self._launch_items(kernels.return_items, given, works, [bars_record], bounds)
        self.done()
        return [list(numbers), self._distinct(sums), *map(list, fields)]

    @property
    def _cells(self) -> int:
        return self.depth * self.height * self.width

    def _slices(self, item: Item) -> int:
        return self.depth if item[0] == 0 else self.height

    def _given(self, is_kept: bool) -> tuple[list[Item], list[int], Any]:
        items, bounds = share_items(
            self.schedule, self.colors, self.threads, is_kept, self.is_apart
        )
        given = records(self.bits).Given()
        given.light = self._light(self.light)
        given.extinction, given.scattering = map(self._array, (self.fields[0], self.fields[-1]))
        given.occupied = self._array(self.occupied)
        given.extinction_channels, given.scattering_channels = (
            len(self.fields[0]),
            len(self.fields[-1]),
        )
        given.numbers = self._array(self.swept.numbers)
        directions, signs = _tables(
            self.schedule, self.plan.weighted, self.like.dtype, self.like.device
        )
        given.directions, given.signs = self._array(directions), self._array(signs)
        given.items = self._array(torch.tensor(items, dtype=torch.int32, device=self.like.device))
        given.depth, given.height, given.width = self.depth, self.height, self.width
        given.colors, given.rows, given.lanes = self.colors, self.rows, self.lanes
        given.stretch = self.stretch
        given.group = max(item[3] for item in items)
        return items, bounds, given

    def _sums(self, items: list[Item], bounds: list[int]) -> list[Tensor]:
        """For each thread empty moments, zero in colors of which it has no item.

        Where each color has one thread they are the same for all.
        """
        shape = len(self.light), *self.light[0].shape
        count = len(self.light) * self.light[0].numel()
        if self.is_apart:
            return [borrow(count, self.like).view(shape)] * self.threads
        # The first becomes the result.
        sums = [] if self.is_turned else [self.like.new_empty(shape)]
        while len(sums) < self.threads:
            sums.append(borrow(count, self.like).view(shape))
        for own, (begin, end) in zip(sums, pairwise(bounds), strict=True):
            for color in set(range(self.colors)) - {item[4] for item in items[begin:end]}:
                own[:, color].zero_()
        return sums

    def _borrow(self, count: int) -> Tensor:
        memory = borrow(count, self.like)
        self.borrowed.append(memory)
        return memory

    def _distinct(self, sums: list[Tensor]) -> list[Tensor]:
        return sums[:1] if self.is_apart else sums

    def _work(self, given: Any, slots: int) -> Any:
        work = records(self.bits).Work()
        size = 2 * self.lanes * given.group * self.rows * self.stretch
        work.buffers, work.slots = self._array(self._borrow(slots * size).zero_()), slots
        work.nothing = self._array(self.like.new_zeros(self.stretch))
        return work

    def _light(self, moments: Sequence[Tensor] | Tensor) -> Any:
        light = records(self.bits).Light()
        for name, i in zip(("mean", "z", "y", "x"), range(4), strict=True):
            setattr(light, name, self._array(moments[i if len(moments) > 1 else 0]))
        return light

    def _array(self, tensor: Tensor) -> Any:
        return array(tensor.detach().reshape(-1))

    def _launch_items(
        self, kernel: Any, given: Any, works: list[Any], more: list[Any], bounds: list[int]
    ) -> None:
        """Runs `kernel` for the items of each thread."""
        limits = self._array(torch.tensor(bounds, dtype=torch.int32, device=self.like.device))
        launch(kernel, self.threads, lambda i: [given, works[i], *more, limits], self.like)

    def _launch_piece(
        self,
        kernel: Any,
        first: int,
        piece: list[Item],
        arguments: list[Any],
        slices: Sequence[int],
    ) -> None:
        """Runs `kernel` slice by slice, for all cells and colors of each."""
        count = self.colors * self._cells // self._slices(piece[0])
        for s in slices:
            launch(kernel, count, [*arguments, first, s], self.like, threads=1)


@functools.cache
def _tables(
    schedule: Schedule, weighted: Weighted, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """`directions` and `signs` as `records.Given` has them."""
    weights = [(*weighted[i][1], 0.0, 0.0, 0.0)[:4] for i in schedule.directions]
    rows = [(*row, *weight) for row, weight in zip(schedule.numbers, weights, strict=True)]
    return (
        torch.tensor(rows, dtype=dtype, device=device),
        torch.tensor(schedule.signs, dtype=torch.int32, device=device),
    )
