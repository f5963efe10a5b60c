"""What a renderer can be told: the `render` and `diffusion` sections of a scene, with their
defaults and legal values.

Each field's metadata is what the scene loader checks: `minimum`, `above`, `maximum`, or `choices`,
a table of implementations.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ddrecon.diffusion.closures import CLOSURES, FLOOR
from ddrecon.diffusion.limiters import LIMITERS
from ddrecon.diffusion.solvers import SOLVERS
from ddrecon.numerics.quadrature import DEGREES

DERIVATIVES = ("all", "single", "diffusion")
"""Which radiance passes derivatives on: all of it, that of beams scattered once, or that of the
diffusion (the paper's Fig. 9).
"""


def bounded(
    default: Any,
    *,
    minimum: float | None = None,
    above: float | None = None,
    maximum: float | None = None,
) -> Any:
    """A number field whose value is at least `minimum`, greater than `above` and at most `maximum`,
    where given.
    """
    return field(default=default, metadata={"minimum": minimum, "above": above, "maximum": maximum})


def one_of(default: Any, choices: Collection[Any]) -> Any:
    """A field whose value is one of `choices`."""
    return field(default=default, metadata={"choices": tuple(choices)})


@dataclass(frozen=True)
class RenderSettings:
    """How view rays are sampled. `background`: ambient light is also seen directly.

    `tolerance`: pixels closer together than half a voxel are interpolated between rays that far
    apart, but for those which that may change by more than this part of the image's root mean
    square; 0: every pixel has its own rays.
    """

    samples_per_pixel: int = bounded(1, minimum=1, maximum=1024)
    steps_per_voxel: int = bounded(1, minimum=1, maximum=8)
    tolerance: float = bounded(0.05, minimum=0, maximum=1)
    background: bool = True


@dataclass(frozen=True)
class DiffusionSettings:
    """How multiply scattered light is found.

    `tolerance` is the relative residual of each linear solve; a reconstruction solves no closer
    than its gradient needs.

    The scheme `printed` is the paper's own, always with the smooth closure and solved by Jacobi
    iteration: `closure` and `solver` are for `conservative`. `floor` is that of the smooth closure.
    The model `flux_limited` has a `limiter` in place of a closure. `transport_rounds` sweeps along
    `transport_directions` directions take P1 towards transport (docs/theory.md, section 5).
    """

    model: str = one_of("p1", ("none", "p1", "flux_limited"))
    scheme: str = one_of("conservative", ("conservative", "printed"))
    closure: str = one_of("geometric", CLOSURES)
    floor: float = bounded(FLOOR, above=0, maximum=1e3)
    limiter: str = one_of("marshak", LIMITERS)
    solver: str = one_of("multigrid", SOLVERS)
    tolerance: float = bounded(1e-4, above=0, maximum=0.5)
    warm_start: bool = True
    transport_rounds: int = bounded(0, minimum=0, maximum=16)
    transport_directions: int = one_of(26, DEGREES)

    def problems(self) -> Iterator[tuple[str, str]]:
        """Settings that exclude each other, as key and what is wrong with it."""
        if self.model == "flux_limited" and self.scheme == "printed":
            yield "scheme", "'printed' is for diffusion.model p1; flux_limited needs 'conservative'"
        if self.transport_rounds > 0 and (self.model, self.scheme) != ("p1", "conservative"):
            yield (
                "transport_rounds",
                "rounds begin at model p1 with scheme 'conservative'; ask for 0 or for these",
            )


Problem = tuple[str, str]


def optional(**limits: float) -> Any:
    """A number, or numbers, within `limits`, that may be left out."""
    return field(default=None, metadata=limits)


@dataclass(frozen=True)
class FieldFile:
    """Values per cell, from a volume file, where they are called `name` (None: as in the scene)."""

    file: Path
    name: str | None = None


Start = float | tuple[float, ...] | FieldFile


@dataclass(frozen=True)
class ParameterSettings:
    """How one parameter is optimized: from `init` (None: what the scene says), within [`min`,
    `max`], by learning rate `lr`.

    `field`: whether it differs from cell to cell (None: if it does so where it starts; density
    always does). `tv` weighs its total variation and `l1` its mean; 1 would weigh them as much as
    the whole brightness of the targets.
    """

    init: Start | None = None
    lr: float | None = optional(above=0)
    min: float | None = None
    max: float | None = None
    tv: float | None = optional(minimum=0)
    l1: float = bounded(0.0, minimum=0)
    field: bool | None = None

    def problems(self) -> Iterator[Problem]:
        low, high = (
            -math.inf if self.min is None else self.min,
            math.inf if self.max is None else self.max,
        )
        entries = self.init if isinstance(self.init, tuple) else (self.init,)
        if high <= low:
            yield "max", f"{high:g} is not above min, {low:g}"
        for entry in entries if low < high else ():
            if isinstance(entry, float) and not low <= entry <= high:
                yield "init", f"{entry:g} is not between min and max"


@dataclass(frozen=True)
class OptimizeSettings:
    """`refine_at`: the fractions of the run at which the grid becomes finer, coarse to fine.

    `views_per_iteration`: how many training views, drawn at random, an iteration looks at; 0 for
    all. `derivatives`: which radiance passes derivatives on: all of it, that scattered once, or
    that scattered more often.
    """

    parameters: Mapping[str, ParameterSettings]
    iterations: int = bounded(300, minimum=1)
    loss: str = one_of("l2", ("l2", "l1", "huber", "relative_l2"))
    optimizer: str = one_of("adam", ("adam",))
    views_per_iteration: int = bounded(3, minimum=0)
    derivatives: str = one_of("all", DERIVATIVES)
    refine_at: tuple[float, ...] = field(default=(0.4, 0.8), metadata={"above": 0, "below": 1})

    def problems(self) -> Iterator[Problem]:
        if any(
            later <= earlier
            for earlier, later in zip(self.refine_at, self.refine_at[1:], strict=False)
        ):
            yield "refine_at", "must increase from each entry to the next"
