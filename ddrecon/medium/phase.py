"""Phase functions: how likely light is scattered by which angle.

They are normalized to 4 pi over the sphere, as in docs/theory.md E2.2. A phase function is known by
its Legendre moments chi_l (E8.1), the mean of P_l(cosine) over scattered light: chi_0 = 1, and
chi_1 is the mean cosine g. Its numbers may differ by color; what is computed from them has the
color as first axis, of size 1 where all colors share one phase function. One of its numbers may
differ from cell to cell, [z, y, x] or [C, z, y, x]: then moments are followed by the cells' axes.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import ClassVar, Self

import torch
from torch import Tensor

from ddrecon.numerics.series import (
    COUNTS,
    angle_of,
    gauss_legendre,
    legendre,
    look_up,
    with_slopes,
)

NEGLIGIBLE = 1e-9
"""Moments below this are left out of series."""


@dataclass(frozen=True, eq=False)
class PhaseFunction(ABC):
    """What every phase function can be asked.

    Its fields are tensors, by which all that it returns is differentiable: its numbers. Or they are
    phase functions, which have some. It is a record to `remember`.
    """

    NAME: ClassVar[str]
    """What a scene file calls it."""
    VARIABLES: ClassVar[tuple[str, ...]] = ()
    """Those of its numbers that can be optimized."""
    CELLWISE: ClassVar[str | None] = None
    """That of its numbers which may differ from cell to cell."""

    @abstractmethod
    def value(self, cosine: Tensor) -> Tensor:
        """p >= 0, normalized to 4 pi, `[C, *cosine.shape]`.

        `cosine`: between the directions of travel before and after scattering, in [-1, 1]. A number
        that differs from cell to cell is here [C or 1, *cosine.shape].
        """

    @abstractmethod
    def moments(self, count: int) -> Tensor:
        """chi_l for l < `count`, [C, count], or of cells [C, count, z, y, x]."""

    def peak_tail(self, degree: int, count: int, sign: int = 1) -> Tensor:
        """The moments f r_l of the forward peak for `count` degrees l > `degree`, [C, count].

        The first is f, the part of scattering that counts as not scattered where light is known to
        `degree` (docs/theory.md E8.5). f is 0 without a forward peak, and the others are at most f.
        With a `sign` of -1 they are of the backward peak, about that direction, and the first is b,
        the part of scattering that counts as turned back (E8.11).
        """
        return torch.zeros_like(self.moments(count))

    @abstractmethod
    def length(self) -> int:
        """How many moments are not negligible; one of `numerics.series.COUNTS`."""

    def map(self, function: Callable[[Tensor], Tensor]) -> Self:
        """The same with what `function` makes of each of its numbers."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        mapped = {
            name: value.map(function) if isinstance(value, PhaseFunction) else function(value)
            for name, value in values.items()
        }
        return replace(self, **mapped)

    @property
    def variables(self) -> dict[str, Tensor]:
        """Those of its numbers that can be optimized, by name."""
        return {name: getattr(self, name) for name in self.VARIABLES}

    @functools.cached_property
    def colors(self) -> int:
        """How many colors have a phase function of their own: 1 where all share one."""
        cells = self.cells
        phase = self if cells is None else self.with_cells(cells[:, :1, :1, :1])
        return len(phase.moments(1))

    @property
    def cells(self) -> Tensor | None:
        """The number that differs from cell to cell, [C, z, y, x]; None where none does."""
        number = None if self.CELLWISE is None else getattr(self, self.CELLWISE)
        return None if number is None or number.ndim < 3 else colored(number)

    def with_cells(self, number: Tensor) -> Self:
        """The same with another `number` in place of that which differs from cell to cell."""
        assert self.CELLWISE is not None
        return replace(self, **{self.CELLWISE: number})

    def move_cells(self, move: Callable[[Tensor], Tensor]) -> Self:
        """The same with what `move` makes of the number that differs from cell to cell, if any."""
        return self if self.cells is None else self.with_cells(move(self.cells))


@dataclass(frozen=True, eq=False)
class HenyeyGreenstein(PhaseFunction):
    """p(w) = (1 - g^2) / (1 + g^2 - 2 g w)^(3/2), chi_l = g^l.

    `g`: mean cosine in (-1, 1), scalar, [3] or of cells. Source: Henyey and Greenstein 1941,
    doi:10.1086/144246.
    """

    NAME = "henyey_greenstein"
    VARIABLES = ("g",)
    CELLWISE = "g"

    g: Tensor

    def value(self, cosine: Tensor) -> Tensor:
        return henyey_greenstein(cosine, beside(self.g, cosine))

    def moments(self, count: int) -> Tensor:
        return _powers(self.g, 0, count)

    def peak_tail(self, degree: int, count: int, sign: int = 1) -> Tensor:
        return _powers((sign * self.g).clamp(min=0), degree + 1, count)

    def length(self) -> int:
        largest = float(self.g.detach().abs().max())
        return next((count for count in COUNTS if largest**count < NEGLIGIBLE), COUNTS[-1])


@dataclass(frozen=True, eq=False)
class Rayleigh(PhaseFunction):
    """p(w) = 3/4 (1 + w^2), of particles much smaller than the wavelength; it has no peak.

    `like`: any tensor of the precision asked for.
    """

    NAME = "rayleigh"

    like: Tensor

    def value(self, cosine: Tensor) -> Tensor:
        return (0.75 * (1 + cosine * cosine))[None]

    def moments(self, count: int) -> Tensor:
        moments = self.like.new_zeros(1, count)
        moments[:, :1], moments[:, 2:3] = 1.0, 0.1
        return moments

    def length(self) -> int:
        return COUNTS[0]


def henyey_greenstein(cosine: Tensor, g: Tensor) -> Tensor:
    """(1 - g^2) / (1 + g^2 - 2 g `cosine`)^(3/2); both broadcast."""
    return (1 - g * g) / (1 + g * g - 2 * g * cosine) ** 1.5


def beside(number: Tensor, cosine: Tensor) -> Tensor:
    """`number`, scalar or [C], to broadcast against `[C, *cosine.shape]`; of cells as it is."""
    return number if number.ndim > 2 else number.reshape(-1, *[1] * cosine.ndim)


def colored(number: Tensor) -> Tensor:
    """A `number` of cells, [z, y, x] or [C, z, y, x], with colors."""
    return number if number.ndim == 4 else number[None]


def beside_degrees(number: Tensor) -> Tensor:
    """`number` to broadcast against moments, [C, 1], or of cells [C, 1, z, y, x]."""
    return colored(number)[:, None] if number.ndim > 2 else number.reshape(-1, 1)


def _powers(g: Tensor, first: int, count: int) -> Tensor:
    """g^l for `count` degrees l from `first` on, [C, count] or [C, count, z, y, x]."""
    degree = torch.arange(first, first + count, dtype=g.dtype, device=g.device)
    base = beside_degrees(g)
    powers: Tensor = base ** degree.view(-1, *[1] * (base.ndim - 2))
    return powers


class Mixture(PhaseFunction):
    """`weight` of the first of two phase functions, and the rest of the second.

    All that it is asked is linear in the weight, which is in [0, 1]: scalar, [3] or of cells.
    """

    CELLWISE = "weight"

    weight: Tensor

    @property
    @abstractmethod
    def parts(self) -> tuple[PhaseFunction, PhaseFunction]:
        """Both phase functions; no number of theirs differs from cell to cell."""

    def value(self, cosine: Tensor) -> Tensor:
        first, second = (phase.value(cosine) for phase in self.parts)
        weight = beside(self.weight, cosine)
        return weight * first + (1 - weight) * second

    def moments(self, count: int) -> Tensor:
        return self._mix(*(phase.moments(count) for phase in self.parts))

    def peak_tail(self, degree: int, count: int, sign: int = 1) -> Tensor:
        return self._mix(*(phase.peak_tail(degree, count, sign) for phase in self.parts))

    def length(self) -> int:
        return max(phase.length() for phase in self.parts)

    def _mix(self, first: Tensor, second: Tensor) -> Tensor:
        """Moments [C, count] of both phase functions as those of the mixture."""
        weight = beside_degrees(self.weight)
        if weight.ndim > 2:
            first, second = first[..., None, None, None], second[..., None, None, None]
        return weight * first + (1 - weight) * second


@dataclass(frozen=True, eq=False)
class TwoLobe(Mixture):
    """`weight` of the first of two Henyey-Greenstein functions, and the rest of the second.

    `g` [2]: their mean cosines; `weight`: in [0, 1], scalar, [3] or of cells.
    """

    NAME = "two_lobe"
    VARIABLES = ("g", "weight")

    g: Tensor
    weight: Tensor

    @property
    def parts(self) -> tuple[HenyeyGreenstein, HenyeyGreenstein]:
        return HenyeyGreenstein(self.g[0]), HenyeyGreenstein(self.g[1])


@dataclass(frozen=True, eq=False)
class Blend(Mixture):
    """`weight` of the phase function `first`, and the rest of `second`: of droplets and air, say.

    Neither is a mixture itself. `weight`: in [0, 1], scalar, [3] or of cells.
    """

    NAME = "blend"

    first: PhaseFunction
    second: PhaseFunction
    weight: Tensor

    @property
    def parts(self) -> tuple[PhaseFunction, PhaseFunction]:
        return self.first, self.second


NODES = 2048
"""Of the quadrature over a table: twice as many as its steps, so that it sees its cubics."""


@dataclass(frozen=True, eq=False)
class Tabulated(PhaseFunction):
    """A smooth curve through `values` at even angles from 0 to pi, over its integral (E8.2).

    `values` >= 0: [C, steps + 1] with C = 1 or 3, of any scale. `at_even_angles` makes them from
    uneven ones.
    """

    NAME = "table"

    values: Tensor

    def value(self, cosine: Tensor) -> Tensor:
        curve = look_up(with_slopes(self.values), angle_of(cosine))[..., 0]
        return (curve / beside(self.mean, cosine)).clamp(min=0).to(cosine.dtype)

    def moments(self, count: int) -> Tensor:
        integrals = self._integrals(count)
        return integrals / integrals[:, :1]

    def peak_tail(self, degree: int, count: int, sign: int = 1) -> Tensor:
        """As many moments as there are of what a forward peak of part f can have.

        f is chi_(degree + 1), but not below 0, and not more than leaves a mean cosine >= 0 to the
        rest. So a function without a forward peak, as Rayleigh's, has none.
        """
        chi = self.moments(degree + count + 1)
        if sign < 0:
            return torch.zeros_like(chi[:, :count])
        peak = torch.minimum(chi[:, degree + 1 : degree + 2], chi[:, 1:2]).clamp(min=0)
        tail = torch.maximum(torch.minimum(chi[:, degree + 2 :], peak), -peak)
        return torch.cat([peak, tail], 1)

    def length(self) -> int:
        large = self.moments(COUNTS[-1]).detach().abs().amax(0) > NEGLIGIBLE
        last = int(large.nonzero().max()) + 1
        return next(count for count in COUNTS if last <= count)

    @property
    def mean(self) -> Tensor:
        """The mean of the curve over the sphere, [C]."""
        return self._integrals(1)[:, 0]

    def _integrals(self, count: int) -> Tensor:
        """Half the integrals over the cosine of the curve times P_l, [C, count]."""
        angles, weights = _quadrature(count)
        curve = look_up(with_slopes(self.values), angles.to(self.values.device))[..., 0]
        return curve @ weights.to(curve)


@functools.lru_cache(maxsize=4)
@torch.inference_mode(False)
def _quadrature(count: int) -> tuple[Tensor, Tensor]:
    """Angles of Gauss's rule, and half its weights times P_l there [NODES, count]."""
    cosine, weights = gauss_legendre(NODES)
    return cosine.acos(), legendre(cosine, count) * (weights / 2)[:, None]
