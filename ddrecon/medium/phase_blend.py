"""Phase functions of two kinds of scatterers, blended by a weight that may differ by cell."""

from __future__ import annotations

import functools
from abc import abstractmethod
from dataclasses import dataclass, fields

from torch import Tensor

from ddrecon.medium.phase import HenyeyGreenstein, PhaseFunction, PhaseKind, beside, beside_degrees


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

    @property
    def numbers(self) -> tuple[Tensor, ...]:
        return *self.first.numbers, *self.second.numbers, self.weight

    @property
    def kind(self) -> PhaseKind:
        return _find_kind(type(self.first), type(self.second))


@functools.cache
def _find_kind(first: type[PhaseFunction], second: type[PhaseFunction]) -> PhaseKind:
    """What makes blends of the numbers of two kinds of phase functions and a weight."""
    count = len(fields(first))

    def blend(*numbers: Tensor) -> Blend:
        return Blend(first(*numbers[:count]), second(*numbers[count:-1]), numbers[-1])

    return blend
