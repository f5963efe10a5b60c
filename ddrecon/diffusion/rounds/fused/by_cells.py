"""A sweep on a GPU: all directions at once, slice by slice, a thread a cell."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.records import struct_kernel, table
from ddrecon.diffusion.rounds.fused.schedule import steps_of
from ddrecon.diffusion.rounds.fused.swept import Parts, Swept, moment_of, units_of_parts
from ddrecon.grid import Grid
from ddrecon.kernels.text import TextKernel
from ddrecon.numerics.harmonics import harmonics

MOST_BYTES = 2**31
"""Arrays of all directions take so much at most; else directions go one part after another."""
BARS = "returning", "far_bar", "mass_bar", "scattered_bar"
NUMBER_BARS = "scale_bars", "strength_bars", "inflow_bars"


@dataclass(frozen=True)
class Directions:
    """Some directions of a sweep, as kernels and sums are given them.

    Of each a `Course` and `Parts`, and what moments [K, D] are made by, `summing` radiance, and
    `spreading` to it; the sum of their `weight`.
    """

    courses: Tensor
    parts: Tensor
    summing: Tensor
    spreading: Tensor
    weight: float


class Cells:
    """The arrays of a sweep on a GPU, and the launches of kernels on them.

    Of a sweep and its `changes`, what is found is the change of what is swept.
    """

    def __init__(self, swept: Swept, changes: Swept | None = None):
        self.swept, self.changes, self.like = swept, changes, swept.total()
        _, self.colors, *self.shape = self.like.shape

    def follow(self) -> Tensor:
        """The moments of radiance [K, C, z, y, x]."""
        found, inflow = torch.zeros_like(self.like), (self.changes or self.swept).scales[2]
        for some in self._parts(arrays=2 if self.changes is None else 4):
            _, made = self._follow(some)
            light = made["light" if self.changes is None else "d_light"]
            found += torch.tensordot(some.summing, light, 1)
            found[0] += some.weight * inflow.view(-1, 1, 1, 1)
        return found

    def transpose(self, bars: Parts, varies_numbers: bool) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Cotangents of `scales` [3, C], of moments and of fields, of those `bars` of light."""
        swept = self.swept
        fields = [torch.zeros_like(field) for field in swept.fields]
        given_bars = torch.zeros_like(self.like)
        for k, total in enumerate(given_bars):
            if (bar := moment_of(bars, k)) is not None:
                total += bar
        found, scales = torch.zeros_like(self.like), torch.zeros_like(swept.scales)
        for some in self._parts(arrays=10):
            given, made = self._follow(some)
            light = made["light"]
            made["bar"] = torch.tensordot(some.summing.T, given_bars, 1).contiguous()
            names = *BARS[: 2 + len(fields)], *NUMBER_BARS * varies_numbers, "q_bars"
            made |= {name: torch.empty_like(light) for name in names}
            flag = f", {str(varies_numbers).lower()}"
            self._cross(f"return_cells<{self._flag}{flag}>", some, given, made, is_backward=True)
            self._kernel(f"collect_cells<{self._flag}>").launch(light.numel(), given, made)
            found += torch.tensordot(some.spreading, made["q_bars"], 1)
            for field, bar in zip(fields, (made["returning"], light), strict=False):
                field += bar.sum(0).sum_to_size(field.shape)
            if varies_numbers:
                sums = [made[name].double().sum((0, 2, 3, 4)) for name in NUMBER_BARS]
                scales += torch.stack(sums).to(scales)
        return scales, found, fields

    @property
    def _flag(self) -> str:
        """Whether extinction and scattering have the same field, in C++."""
        return str(self.swept.scattering is None).lower()

    def _parts(self, arrays: int) -> Iterator[Directions]:
        """Directions, so many at once that `arrays` of them have room."""
        of = self.swept.grid, self.swept.directions
        size = arrays * self.like[0].numel() * self.like.element_size()
        most = max(1, MOST_BYTES // size)
        degree = round(len(self.like) ** 0.5) - 1
        for first in range(0, len(steps_of(*of)), most):
            place = self.like.dtype, self.like.device
            yield _directions(*of, first, most, degree, *place)

    def _follow(self, some: Directions) -> tuple[dict[str, Any], dict[str, Any]]:
        """What kernels are given, and radiance along directions, `light` [D, C, z, y, x]."""
        swept, changes, number = self.swept, self.changes, "F"
        near = torch.tensordot(some.spreading.T, self.like, 1)
        made = {"light": near.new_empty(near.shape)}
        given = {
            "near": near, "scales": swept.scales, "parts": some.parts, "courses": some.courses,
            "extinction": swept.fields[0], "extinction_channels": len(swept.fields[0]),
            "scattering": swept.fields[-1], "scattering_channels": len(swept.fields[-1]),
            "shape": self.shape, "colors": self.colors, "most": self._most, "slice": 0,
        }  # fmt: skip
        if changes is not None:
            number = "Dual<F>"
            made["d_light"] = near.new_empty(near.shape)
            given |= {
                "d_near": torch.tensordot(some.spreading.T, swept.total_change(changes), 1),
                "d_extinction": changes.fields[0], "d_scattering": changes.fields[-1],
                "d_scales": changes.scales,
            }  # fmt: skip
        self._cross(f"follow_cells<{number}, {self._flag}>", some, given, made)
        return given, made

    @property
    def _most(self) -> int:
        """Cells of the largest slice."""
        return torch.Size(self.shape).numel() // min(self.shape)

    def _cross(
        self,
        function: str,
        some: Directions,
        given: dict[str, Any],
        made: dict[str, Any],
        is_backward: bool = False,
    ) -> None:
        """Goes through the slices, one after the other."""
        bound, slices = self._kernel(function).bind(given, made), range(max(self.shape))
        for number in reversed(slices) if is_backward else slices:
            bound.launch(len(some.courses) * self.colors * self._most, slice=number)

    def _kernel(self, function: str) -> TextKernel:
        return cell_kernel(function, torch.finfo(self.like.dtype).bits)


@functools.cache
def _directions(
    grid: Grid,
    directions: int,
    first: int,
    most: int,
    degree: int,
    dtype: torch.dtype,
    device: torch.device,
) -> Directions:
    """At most so many directions of a sweep from the `first`; a GPU would wait for each copy."""
    steps, weights = zip(*steps_of(grid, directions)[first : first + most], strict=True)
    weight, ways = (
        torch.tensor(each, dtype=torch.float64)
        for each in (weights, [step.direction for step in steps])
    )
    values, units = harmonics(ways, degree), units_of_parts(degree)[:, None]
    with torch.inference_mode(False):
        return Directions(
            table("Course", [step.course() for step in steps]).to(device),
            torch.tensor([step.parts() for step in steps], dtype=dtype, device=device),
            (units * values * weight).to(device, dtype),
            (values / units).to(device, dtype),
            math.fsum(weights),
        )


@functools.cache
def cell_kernel(function: str, bits: int) -> TextKernel:
    """The kernel of a function of `sweep_cells.h`."""
    return struct_kernel(function.split("<")[0], bits, "sweep_cells.h", "CellSweep", function)
