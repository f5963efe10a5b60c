"""A sweep on a GPU: all directions at once, slice by slice, a thread a cell."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.cells import COLLECT_CELL, FOLLOW_CELL, GIVEN, RETURN_CELL
from ddrecon.diffusion.rounds.fused.schedule import POINTS, steps_of
from ddrecon.diffusion.rounds.fused.share import constants
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

    Of each, whole `numbers` [D, 17] and `parts` [D, 5] of its step, and what moments [K, D] are
    made by, `summing` radiance, and `spreading` to it; the sum of their `weight`.
    """

    numbers: Tensor
    parts: Tensor
    summing: Tensor
    spreading: Tensor
    weight: float

    @property
    def count(self) -> int:
        """How many they are."""
        return len(self.numbers)


class Cells:
    """The arrays of a sweep on a GPU, and the launches of kernels on them."""

    def __init__(self, swept: Swept):
        self.swept, self.like = swept, swept.total()
        _, self.colors, *self.shape = self.like.shape
        self.kernels = functools.partial(
            cell_kernels, torch.finfo(self.like.dtype).bits, swept.scattering is None
        )

    def follow(self) -> Tensor:
        """The moments of radiance [K, C, z, y, x]."""
        found = torch.zeros_like(self.like)
        for some in self._parts(arrays=2):
            found += torch.tensordot(some.summing, self._follow(some)["light"], 1)
            found[0] += some.weight * self.swept.scales[2].view(-1, 1, 1, 1)
        return found

    def transpose(self, bars: Parts, varies_numbers: bool) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Cotangents of `scales` [3, C], of moments and of fields, of those `bars` of light."""
        swept, (_, back, collect) = self.swept, self.kernels(varies_numbers)
        fields = [torch.zeros_like(field) for field in swept.fields]
        given_bars = torch.zeros_like(self.like)
        for k, total in enumerate(given_bars):
            if (bar := moment_of(bars, k)) is not None:
                total += bar
        found, scales = torch.zeros_like(self.like), torch.zeros_like(swept.scales)
        for some in self._parts(arrays=10):
            given = self._follow(some)
            light = given["light"]
            given["bar"] = torch.tensordot(some.summing.T, given_bars, 1)
            names = BARS[: 2 + len(fields)] + NUMBER_BARS * varies_numbers
            given |= {name: torch.empty_like(light) for name in names}
            for number in reversed(range(max(self.shape))):
                self._launch(back, given | {"slice": number}, some.count * self.colors * self.most)
            given["q_bars"] = q_bars = torch.empty_like(light)
            self._launch(collect, given, light.numel())
            found += torch.tensordot(some.spreading, q_bars, 1)
            for field, bar in zip(fields, (given["returning"], light), strict=False):
                field += bar.sum(0).sum_to_size(field.shape)
            if varies_numbers:
                scales += torch.stack(
                    [given[n].double().sum((0, 2, 3, 4)).to(scales) for n in NUMBER_BARS]
                )
        return scales, found, fields

    @property
    def most(self) -> int:
        """Cells of the largest slice."""
        return torch.Size(self.shape).numel() // min(self.shape)

    def _parts(self, arrays: int) -> Iterator[Directions]:
        """Directions, so many at once that `arrays` of them have room."""
        of = self.swept.grid, self.swept.directions
        size = arrays * self.like[0].numel() * self.like.element_size()
        most = max(1, MOST_BYTES // size)
        degree = round(len(self.like) ** 0.5) - 1
        for first in range(0, len(steps_of(*of)), most):
            place = self.like.dtype, self.like.device
            yield _directions(*of, first, most, degree, *place)

    def _follow(self, some: Directions) -> dict[str, Any]:
        """Radiance along directions, `light` [D, C, z, y, x], and what else kernels are given."""
        swept, like = self.swept, self.like
        near = torch.tensordot(some.spreading.T, like, 1).contiguous()
        scattering = swept.extinction if swept.scattering is None else swept.scattering
        depth, height, width = self.shape
        given: dict[str, Any] = {
            "near": near, "light": torch.empty_like(near),
            "extinction": swept.extinction.contiguous(), "scattering": scattering.contiguous(),
            "scales": swept.scales, "parts": some.parts, "steps": some.numbers,
            "extinction_channels": len(swept.extinction), "scattering_channels": len(scattering),
            "depth": depth, "height": height, "width": width, "colors": self.colors,
            "most": self.most, "slice": 0,
        }  # fmt: skip
        for number in range(max(self.shape)):
            self._launch(
                self.kernels(False)[0],
                given | {"slice": number},
                some.count * self.colors * self.most,
            )
        return given

    def _launch(self, kernel: TextKernel, values: dict[str, Any], count: int) -> None:
        made = {name: value for name, value in values.items() if name in kernel.made}
        kernel.launch(count, {n: v for n, v in values.items() if n not in made}, made)


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
    numbers, parts = [], []
    for step in steps:
        fill = POINTS - len(step.points)
        places = [n for point in step.points for n in point] + [0] * 3 * fill
        numbers.append([*step.signs, step.axis, len(step.points), *places])
        parts.append([step.half, *step.weights, *[0.0] * fill])
    weight, ways = (
        torch.tensor(each, dtype=torch.float64)
        for each in (weights, [step.direction for step in steps])
    )
    values, units = harmonics(ways, degree), units_of_parts(degree)[:, None]
    with torch.inference_mode(False):
        return Directions(
            torch.tensor(numbers, dtype=torch.int32, device=device),
            torch.tensor(parts, dtype=dtype, device=device),
            (units * values * weight).to(device, dtype),
            (values / units).to(device, dtype),
            math.fsum(weights),
        )


@functools.cache
def cell_kernels(bits: int, shares_field: bool, varies_numbers: bool) -> list[TextKernel]:
    """The kernels that follow radiance, follow it back, and collect what steps from a cell have."""
    fixed = constants(SHARES_FIELD=shares_field, VARIES_NUMBERS=varies_numbers)
    texts = {
        "follow": (FOLLOW_CELL, "light"),
        "return": (RETURN_CELL, " ".join(("bar", *BARS, *NUMBER_BARS))),
        "collect": (COLLECT_CELL, "q_bars returning light"),
    }
    return [
        TextKernel(f"{name}_cells", bits, fixed + text, GIVEN, made)
        for name, (text, made) in texts.items()
    ]
