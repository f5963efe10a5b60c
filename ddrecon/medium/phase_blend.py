"""Phase functions of two kinds of scatterers, blended by a weight that may differ by cell."""

from __future__ import annotations

import functools
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields

from torch import Tensor

from ddrecon.medium.phase import HenyeyGreenstein, PhaseFunction, PhaseKind, beside, colored


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

    @functools.cached_property
    def colors(self) -> int:
        own = 1 if self.weight.ndim in (0, 3) else len(self.weight)
        return max(own, *(part.colors for part in self.parts))

    def value(self, cosine: Tensor) -> Tensor:
        first, second = (part.value(cosine) for part in self.parts)
        weight = beside(self.weight, cosine)
        return weight * first + (1 - weight) * second

    def moments(self, count: int) -> Tensor:
        return self._mix([part.moments(count) for part in self.parts])

    def peak_tail(self, degree: int, count: int) -> Tensor:
        return self._mix([part.peak_tail(degree, count) for part in self.parts])

    def backward_tail(self, degree: int, count: int) -> Tensor:
        return self._mix([part.backward_tail(degree, count) for part in self.parts])

    def length(self) -> int:
        return max(part.length() for part in self.parts)

    def _mix(self, parts: Sequence[Tensor]) -> Tensor:
        """Moments [C, count] of both parts as those of the mixture."""
        weight = self.weight.reshape(-1, 1)
        if self.weight.ndim > 2:
            weight = colored(self.weight)[:, None]
            parts = [part[..., None, None, None] for part in parts]
        return weight * parts[0] + (1 - weight) * parts[1]


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
        return _BlendOf(type(self.first), type(self.second))


@dataclass(frozen=True)
class _BlendOf:
    """Makes blends of the numbers of two kinds of phase functions and a weight."""

    first: type[PhaseFunction]
    second: type[PhaseFunction]

    def __call__(self, *numbers: Tensor) -> Blend:
        count = len(fields(self.first))
        return Blend(self.first(*numbers[:count]), self.second(*numbers[count:-1]), numbers[-1])
