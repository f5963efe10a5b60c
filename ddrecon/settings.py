"""The sections `render`, `diffusion` and `optimize` of a scene: defaults and legal values.

The `choices` of a field are the names of a table of implementations. No table is loaded here: a
scene file is read without torch. `violations` yields what is wrong with several values together.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ddrecon.records import Violation, bounded, one_of

FLOOR = 3.3
"""Optical thickness of empty space across the box's shortest side, by the closure `smooth`."""
LENSES = {"opencv": ("k1", "k2", "k3", "k4", "p1", "p2"), "fisheye": ("k1", "k2", "k3", "k4")}
"""The coefficients of each model of a lens, in order; all are 0 where there is no distortion."""


@dataclass(frozen=True)
class RenderSettings:
    """How view rays are sampled.

    `steps_per_voxel` is chosen by the medium where it is None. Pixels closer together than half a
    voxel are interpolated between rays half a voxel apart, unless that may change a pixel by more
    than `tolerance` of the image's root mean square; 0 gives every pixel a ray of its own.
    `background`: ambient light and environment maps are also seen directly.
    """

    samples_per_pixel: int = bounded(1, minimum=1, maximum=1024)
    steps_per_voxel: int | None = bounded(None, minimum=1, maximum=8, expert=True)
    tolerance: float = bounded(0.05, minimum=0, maximum=1, expert=True)
    background: bool = True

    @property
    def steps(self) -> int:
        """Samples a cell along a ray: 1 where `steps_per_voxel` is None."""
        return self.steps_per_voxel or 1


@dataclass(frozen=True)
class DiffusionSettings:
    """How multiply scattered light is computed.

    `tolerance` is the relative residual of each linear solve; a reconstruction solves less closely
    where its gradient needs no more. The scheme `printed` is the paper's own, always with the
    closure `smooth`, whose empty space has the optical thickness `floor`; the model `flux_limited`
    has no closure. `transport_rounds` of sweeps take P1 towards transport, with angles up to
    `degree`; with a `transport_tolerance` rounds end where one changes light by less of it
    (docs/theory.md, section 7). Cells of light are `refine` times as narrow along `refine_along`.
    What is None is chosen by the medium.
    """

    model: str = one_of("p1", ("none", "p1", "flux_limited"))
    scheme: str = one_of("conservative", ("conservative", "printed"), expert=True)
    closure: str = one_of("geometric", ("geometric", "smooth"), expert=True)
    floor: float = bounded(FLOOR, above=0, maximum=1e3, expert=True)
    tolerance: float = bounded(1e-4, above=0, maximum=0.5)
    warm_start: bool = bounded(True, expert=True)
    transport_rounds: int | None = bounded(None, minimum=0, maximum=16)
    transport_tolerance: float | None = bounded(None, above=0, below=1)
    degree: int | None = one_of(None, (1, 3, 5, 7))
    refine: int | None = one_of(None, (1, 3, 9), expert=True)
    refine_along: str = one_of("xyz", ("x", "y", "z", "xy", "xz", "yz", "xyz"), expert=True)

    @property
    def is_conservative_p1(self) -> bool:
        """Whether diffusion is that with which transport rounds begin."""
        return (self.model, self.scheme) == ("p1", "conservative")

    @property
    def rounds(self) -> int:
        """The most transport rounds: where None, one if any are possible."""
        return (
            int(self.is_conservative_p1) if self.transport_rounds is None else self.transport_rounds
        )

    @property
    def angles(self) -> int:
        """The degree up to which light's angles are kept: where None 3, without rounds 1."""
        return (self.degree or 3) if self.rounds else 1

    @property
    def times(self) -> int:
        """How many times as narrow as the medium's the cells of light are."""
        return self.refine or 1

    def violations(self) -> Iterator[Violation]:
        if self.model == "flux_limited" and self.scheme == "printed":
            yield "scheme", "'printed' is for diffusion.model p1; flux_limited needs 'conservative'"
        if self.rounds > 0 and not self.is_conservative_p1:
            yield (
                "transport_rounds",
                "rounds begin at model p1 with scheme 'conservative'; ask for 0 or for these",
            )
        if self.transport_tolerance is not None and not self.rounds:
            yield "transport_tolerance", "there are no transport rounds to end; leave it out"


@dataclass(frozen=True)
class FieldFile:
    """Values per cell from a volume file, which calls them `name` (None: as the scene does)."""

    file: Path
    name: str | None = None


Start = float | tuple[float, ...] | FieldFile
"""Where a parameter starts: the same number everywhere, a vector or color, or a file's values."""

Iterations = int | Literal["auto"]
"""How many iterations a run has, or `auto`: it ends by itself."""
AUTO: Literal["auto"] = "auto"
MASKS = "masks"
MARGIN = 2.0
"""By how many pixels what a view shows is widened, unless a scene says."""


@dataclass(frozen=True)
class ParameterSettings:
    """How one parameter is optimized.

    It starts from `init` (None: the scene's own value) and stays within [`min`, `max`]. `field`:
    whether it differs from cell to cell (None: if its start does; density always does). `tv` weighs
    its total variation, of density by E11.3; 1 weighs it as much as the whole brightness of the
    targets. `support`: density is 0 outside what pictures show, by `masks` or, `auto`, by what is
    brighter than black, widened by `support_margin` pixels, or `MARGIN`; None allows it anywhere.
    """

    init: Start | None = None
    min: float | None = None
    max: float | None = None
    tv: float | None = bounded(None, minimum=0)
    field: bool | None = None
    support: str | None = one_of(None, (MASKS, AUTO))
    support_margin: float | None = bounded(None, minimum=0, maximum=1000)

    @property
    def margin(self) -> float:
        """By how many pixels what a view shows is widened."""
        return MARGIN if self.support_margin is None else self.support_margin

    def violations(self) -> Iterator[Violation]:
        low = -math.inf if self.min is None else self.min
        high = math.inf if self.max is None else self.max
        entries = self.init if isinstance(self.init, tuple) else (self.init,)
        if high <= low:
            yield "max", f"{high:g} is not above min, {low:g}"
        for entry in entries if low < high else ():
            if isinstance(entry, float) and not low <= entry <= high:
                yield "init", f"{entry:g} is not between min and max"


@dataclass(frozen=True)
class NoiseSettings:
    """How pictures err: `read`, the standard deviation at black, and `shot`, variance by radiance.

    Both are in units of a picture's linear values, of which 1 is white.
    """

    read: float = bounded(0.0, minimum=0)
    shot: float = bounded(0.0, minimum=0)

    def violations(self) -> Iterator[Violation]:
        if self.read == self.shot == 0:
            yield "read", "no noise at all; give read or shot, or leave noise out to estimate it"


@dataclass(frozen=True)
class OptimizeSettings:
    """What is optimized, and how.

    `iterations`: the most; with `auto` a run ends when it is done, see `reconstruct.schedule`.
    `loss`: None is chosen by the kind of pictures. `noise`: of all pictures without their own, for
    the loss `photon` and to know when only noise is left. `derivatives`: the radiance that passes
    derivatives on: all of it, that scattered once, or that of the diffusion (the paper's Fig. 9).
    `keep_start`: the share of the fields' start that is mixed into them in the end.
    """

    parameters: Mapping[str, ParameterSettings]
    iterations: Iterations = bounded(AUTO, minimum=1)
    loss: str | None = one_of(None, ("l2", "l1", "huber", "relative_l2", "display", "photon"))
    noise: NoiseSettings | None = None
    derivatives: str = one_of("all", ("all", "single", "diffusion"), expert=True)
    keep_start: float = bounded(0.0, minimum=0, below=1, expert=True)
