"""Phase functions: how likely light is scattered by which angle.

They are normalized to 4 pi over the sphere, as in docs/theory.md E2.2. A phase function is known by
its Legendre moments chi_l (E8.1), the mean of P_l(cosine) over scattered light: chi_0 = 1, and
chi_1 is the mean cosine g. Its numbers may differ by color; what is computed from them has the
color as first axis, of size 1 where all colors share one phase function. One of its numbers may
differ from cell to cell, [z, y, x] or [C, z, y, x]: then moments are followed by the cells' axes.

`SeenPhase` replaces p for a beam seen along a view ray, whose peak was scaled out. Light that the
forward peak alone has scattered, often or once, is still on its way; at a depth x of the peak it
has spread (docs/theory.md E8.7, E8.6). Along a ray only x changes: the function is a polynomial in
(x - s) / (x + s), whose coefficients are kept over the angle. A number that differs from cell to
cell is interpolated to the nodes of rays, as density is. There S of E8.7 is a polynomial in that
number too (E8.9). Of Henyey and Greenstein's function the polynomial is of S over p, so that S is
exact without a peak.
"""

import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import ClassVar, Self

import torch
from torch import Tensor

from ddrecon.numerics.decay import decay_mean
from ddrecon.numerics.remember import remember
from ddrecon.numerics.series import (
    COEFFICIENTS,
    COUNTS,
    STEPS,
    angle_of,
    depth_at,
    depth_place,
    evaluate,
    even_angles,
    extrema,
    fejer,
    legendre,
    legendre_at_even_angles,
    look_up,
    series_weights,
    sum_series,
    with_slopes,
)

NEGLIGIBLE = 1e-9
"""Moments below this are left out of series."""
NODES = 4096
"""Of the quadrature over a table: twice the degrees of a series, and four for each of its steps."""
WEIGHT_POWERS = 4
"""Coefficients over a weight: S of two forward lobes is within about 2 % of E8.7."""
STEEPEST = 0.99
"""The largest g of tables. Over artanh g up to there, S has as many coefficients as over depth."""


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
    """Angles of a rule, and half its weights times P_l there [NODES, count]."""
    angle, weights = fejer(NODES)
    return angle, legendre(angle.cos(), count) * (weights / 2)[:, None]


@dataclass(frozen=True, eq=False)
class SeenPhase:
    """A phase function as view rays see light of beams scattered by it.

    `phase`: the function; `degree`: light is known to this degree in angle, and peaks beyond it
    count as not scattered. Where `phase` differs from cell to cell, `number` [N, 1 or C, R] is that
    of its numbers which does, at N nodes of R rays.
    """

    phase: PhaseFunction
    degree: int
    number: Tensor | None = None

    def along(self, depth: Tensor | None, cosine: Tensor) -> Tensor:
        """S at `depth` [N, C, R], or p where that is None, along rays of one `cosine` [R] each.

        It is [N, C, R], or without depth and number [C, R].
        """
        if depth is None and self.number is None:
            return self.phase.value(cosine)
        return self._look_up(angle_of(cosine)[None], depth, cosine)

    def at_angles(self, depth: Tensor | None, angle: Tensor) -> Tensor:
        """S, or p where `depth` is None, [N, C, R] at `depth` [N, C, R] and `angle` [N, R]."""
        return self._look_up(angle, depth, angle.cos()[:, None])

    def _look_up(self, angle: Tensor, depth: Tensor | None, cosine: Tensor) -> Tensor:
        """As `at_angles`, with one `angle` [1, R] for all nodes of a ray as well."""
        has_peak, terms = depth is not None, 1 if depth is None else COEFFICIENTS
        coefficients = look_up(self.table(has_peak).to(cosine.dtype), angle.double())
        rows = coefficients.permute(3, 1, 0, 2).unflatten(0, (-1, terms))
        seen = [row[0] if depth is None else evaluate(row, depth_place(depth)) for row in rows]
        if self.number is None:
            return seen[0].clamp(min=0) if has_peak else seen[0]
        value = sum_series(seen, number_place(self.phase, self.number))
        value = value.clamp(min=0) if has_peak else value
        return henyey_greenstein(cosine, self.number) * value if is_scaled(self.phase) else value

    def table(self, has_peak: bool) -> Tensor:
        """Of S its coefficients, [C, steps + 1, 2, K], or without a peak of p the values.

        At even angles, with slopes by the angle (`numerics.series`), in double precision. Of a
        phase function that differs from cell to cell K is as `number_table` has it.
        """
        make, degree = (_peak_table, (self.degree,)) if has_peak else (_plain_table, ())
        if self.phase.cells is None:
            return make(self.phase, *degree)
        return number_table(self.phase, make, has_peak, 1, *degree)


def is_scaled(phase: PhaseFunction) -> bool:
    """Whether the number is g, and tables have S over p; else p is linear in it, a weight."""
    return isinstance(phase, HenyeyGreenstein)


def count_powers(phase: PhaseFunction, has_peak: bool) -> int:
    """Coefficients of S over the number that differs from cell to cell, 1 where none does."""
    if phase.cells is None:
        return 1
    if is_scaled(phase):
        return COEFFICIENTS if has_peak else 1
    return WEIGHT_POWERS if has_peak else 2


def number_place(phase: PhaseFunction, number: Tensor) -> Tensor:
    """`number` from -1 to 1 in polynomials: of a weight, or of g by its artanh, 0 and less as 0."""
    if not is_scaled(phase):
        return 2 * number - 1
    g = torch.where(number > 0, number, torch.zeros_like(number))
    g = torch.where(g < STEEPEST, g, torch.full_like(g, STEEPEST))
    return torch.atanh(g) / (math.atanh(STEEPEST) / 2) - 1


def number_table(
    phase: PhaseFunction, make: Callable[..., Tensor], has_peak: bool, sign: int, *arguments: int
) -> Tensor:
    """Coefficients over the number of the tables that `make` has of `phase` and `arguments`.

    They are [C, steps + 1, 2, powers K], of tables [C, steps + 1, 2, K], with so many powers as
    `count_powers` says. `sign` is that of g.
    """
    assert phase.cells is not None
    numbers = _fitted_numbers(
        is_scaled(phase), count_powers(phase, has_peak), sign, phase.cells.device
    )
    return _fit(phase.with_cells(numbers), numbers, make, *arguments)


@functools.cache
@torch.inference_mode(False)
def _fitted_numbers(is_g: bool, powers: int, sign: int, device: torch.device) -> Tensor:
    """The numbers [`powers`] at which polynomials are fitted."""
    places, *_ = extrema(powers)
    half = (places + 1) / 2
    return (sign * torch.tanh(math.atanh(STEEPEST) * half) if is_g else half).to(device)


@remember
def _fit(
    phase: PhaseFunction, numbers: Tensor, make: Callable[..., Tensor], *arguments: int
) -> Tensor:
    """As `number_table`, of a `phase` with all `numbers` at which polynomials are fitted."""
    # one after the other: weak peaks have short series
    phases = [phase.with_cells(number) for number in numbers]
    tables = torch.stack([make(at_number, *arguments) for at_number in phases])
    if is_scaled(phase):
        # S over p, where p is summed as S is
        moments = (at_number.moments(at_number.length()).double() for at_number in phases)
        sums = torch.stack([tabulate_series(series_weights(chi)[..., None]) for chi in moments])
        p, d_p = sums.unbind(-2)
        values, slopes = tables.unbind(-2)
        ratio = values / p
        tables = torch.stack([ratio, (slopes - ratio * d_p) / p], -2)
    *_, to_series = extrema(len(phases))
    coefficients = torch.tensordot(to_series.to(tables), tables, 1)
    return coefficients.movedim(0, -2).flatten(-2).contiguous()


def tabulate_series(weights: Tensor) -> Tensor:
    """Sums over l of `weights` [C, count, K] times P_l as a table [C, steps + 1, 2, K]."""
    curves = legendre_at_even_angles(STEPS, weights.shape[1])
    return torch.stack([rows.to(weights) @ weights for rows in curves], 2)


def peak_moments(phase: PhaseFunction, degree: int, sign: int = 1) -> tuple[Tensor, Tensor]:
    """All moments f r_l of a peak, and all r_l, which are 1 up to `degree` (E8.5).

    `sign` is as of `PhaseFunction.peak_tail`.
    """
    tail = phase.peak_tail(degree, phase.length() - degree - 1, sign).double()
    fraction = tail[:, :1]
    low = fraction.expand(-1, degree + 1, *tail.shape[2:])
    # Without a peak r_l beyond `degree` does not matter.
    spread = tail / torch.where(fraction > 0, fraction, 1)
    return torch.cat([low, tail], 1), torch.cat([torch.ones_like(low), spread], 1)


def peaked_series(phase: PhaseFunction, degree: int, depth: Tensor) -> Tensor:
    """(2 l + 1) times the moments s_l of S at `depth` [C or 1, ..., 1], [C, ..., count] (E8.6)."""
    moments = phase.moments(phase.length()).double(), *peak_moments(phase, degree)
    chi, peak, spread = (
        numbers.movedim(1, -1).unflatten(0, (-1, *[1] * (depth.ndim - numbers.ndim)))
        for numbers in moments
    )
    # exp(-x (1 - r)) phi(r x), which is exp(-x) phi(-r x) for r < 0.
    forward, size = spread.clamp(min=0), spread.abs()
    turned = torch.exp((forward - 1) * depth) * decay_mean(size * depth)
    return series_weights(chi - peak + peak * turned)


@remember
def _plain_table(phase: PhaseFunction) -> Tensor:
    cosines = even_angles(STEPS).to(phase.moments(1).device).cos()
    return with_slopes(phase.map(Tensor.double).value(cosines))


@remember
def _peak_table(phase: PhaseFunction, degree: int) -> Tensor:
    """The polynomials of S, [C, steps + 1, 2, COEFFICIENTS], of a phase function."""
    places, inverse, _ = (array.to(phase.moments(1).device) for array in extrema(COEFFICIENTS))
    # At the depths of the fit, and from these to coefficients: [C, count, COEFFICIENTS].
    series = peaked_series(phase.map(Tensor.double), degree, depth_at(places)[None, :, None])
    return tabulate_series((inverse @ series).mT)
