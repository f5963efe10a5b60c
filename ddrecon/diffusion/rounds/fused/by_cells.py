"""A sweep on a GPU: all directions at once, slice by slice, a thread a cell."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.cells import COLLECT_CELL, FOLLOW_CELL, GIVEN, RETURN_CELL
from ddrecon.diffusion.rounds.fused.schedule import POINTS, Step, steps_of
from ddrecon.diffusion.rounds.fused.share import constants
from ddrecon.diffusion.rounds.fused.swept import Parts, Swept, moment_of, units_of_parts
from ddrecon.kernels.text import TextKernel
from ddrecon.numerics.harmonics import harmonics

MOST_BYTES = 2**31
"""Arrays of all directions take so much at most; else directions go one part after another."""
BARS = "returning", "far_bar", "mass_bar", "scattered_bar"
NUMBER_BARS = "scale_bars", "strength_bars", "inflow_bars"


class Cells:
    """The arrays of a sweep on a GPU, and the launches of kernels on them."""

    def __init__(self, swept: Swept):
        self.swept, self.like = swept, swept.total()
        count, self.colors, *self.shape = self.like.shape
        self.units = units_of_parts(round(count**0.5) - 1)[:count, None]
        self.kernels = functools.partial(
            cell_kernels, torch.finfo(self.like.dtype).bits, swept.scattering is None
        )

    def follow(self) -> Tensor:
        """The moments of radiance [K, C, z, y, x]."""
        found = torch.zeros_like(self.like)
        for steps, values, weights in self._parts(arrays=2):
            light = self._follow(steps, values)["light"]
            found += torch.tensordot((self.units * values * weights).to(light), light, 1)
            found[0] += float(weights.sum()) * self.swept.scales[2].view(-1, 1, 1, 1)
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
        for steps, values, weights in self._parts(arrays=10):
            given = self._follow(steps, values)
            light = given["light"]
            given["bar"] = torch.tensordot(
                (self.units * values * weights).T.to(light), given_bars, 1
            )
            names = BARS[: 2 + len(fields)] + NUMBER_BARS * varies_numbers
            given |= {name: torch.empty_like(light) for name in names}
            for number in reversed(range(max(self.shape))):
                self._launch(back, given | {"slice": number}, len(steps) * self.colors * self.most)
            given["q_bars"] = q_bars = torch.empty_like(light)
            self._launch(collect, given, light.numel())
            found += torch.tensordot((values / self.units).to(q_bars), q_bars, 1)
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

    def _parts(self, arrays: int) -> Iterator[tuple[list[Step], Tensor, Tensor]]:
        """Steps, their Y_k [K, D], and weights [D], so many that `arrays` of them have room."""
        steps = steps_of(self.swept.grid, self.swept.directions)
        size = arrays * self.like[0].numel() * self.like.element_size()
        most = max(1, MOST_BYTES // size)
        degree = round(len(self.like) ** 0.5) - 1
        for first in range(0, len(steps), most):
            some, weights = zip(*steps[first : first + most], strict=True)
            ways = torch.tensor([step.direction for step in some], dtype=torch.float64)
            weight = torch.tensor(weights, dtype=torch.float64)
            yield list(some), harmonics(ways, degree), weight

    def _follow(self, steps: list[Step], values: Tensor) -> dict[str, Any]:
        """Radiance along `steps`, `light` [D, C, z, y, x], and what else kernels are given."""
        swept, like = self.swept, self.like
        near = torch.tensordot((values / self.units).T.to(like), like, 1).contiguous()
        numbers, parts = _tables(tuple(steps))
        scattering = swept.extinction if swept.scattering is None else swept.scattering
        depth, height, width = self.shape
        given: dict[str, Any] = {
            "near": near, "light": torch.empty_like(near),
            "extinction": swept.extinction.contiguous(), "scattering": scattering.contiguous(),
            "scales": swept.scales, "parts": parts.to(like), "steps": numbers.to(like.device),
            "extinction_channels": len(swept.extinction), "scattering_channels": len(scattering),
            "depth": depth, "height": height, "width": width, "colors": self.colors,
            "most": self.most, "slice": 0,
        }  # fmt: skip
        for number in range(max(self.shape)):
            self._launch(
                self.kernels(False)[0],
                given | {"slice": number},
                len(steps) * self.colors * self.most,
            )
        return given

    def _launch(self, kernel: TextKernel, values: dict[str, Any], count: int) -> None:
        given = dict(values)
        kernel.launch(count, given, {"light": given.pop("light")})


@functools.cache
def _tables(steps: tuple[Step, ...]) -> tuple[Tensor, Tensor]:
    """Of each step whole numbers [D, 17] and parts [D, 5], as kernels read them."""
    numbers, parts = [], []
    for step in steps:
        fill = POINTS - len(step.points)
        places = [n for point in step.points for n in point] + [0] * 3 * fill
        numbers.append([*step.signs, step.axis, len(step.points), *places])
        parts.append([step.half, *step.weights, *[0.0] * fill])
    return torch.tensor(numbers, dtype=torch.int32), torch.tensor(parts, dtype=torch.float64)


@functools.cache
def cell_kernels(bits: int, shares_field: bool, varies_numbers: bool) -> list[TextKernel]:
    """The kernels that follow radiance, follow it back, and collect what steps from a cell have."""
    fixed = constants(SHARES_FIELD=shares_field, VARIES_NUMBERS=varies_numbers)
    texts = {"follow": FOLLOW_CELL, "return": RETURN_CELL, "collect": COLLECT_CELL}
    return [TextKernel(f"{n}_cells", bits, fixed + text, GIVEN) for n, text in texts.items()]
