"""The sections `render`, `diffusion` and `optimize` of a scene: defaults and legal values.

The `choices` of a field are the names of a table of implementations. No table is loaded here: a
scene file is read without torch. `violations` yields what is wrong with several values together.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ddrecon.records import Violation, bounded, one_of

MOST_AROUND = 10000
"""Cameras of a ring, at most."""
LENSES = {"opencv": ("k1", "k2", "k3", "k4", "p1", "p2"), "fisheye": ("k1", "k2", "k3", "k4")}
"""The coefficients of each model of a lens, in order; all are 0 where there is no distortion."""


@dataclass(frozen=True)
class RenderSettings:
    """How view rays are sampled.

    samples_per_pixel: Rays a pixel, over its area; one goes through its center.
    steps_per_voxel: Samples a cell along a ray. Left out: 2 where a cell is thicker than 0.75
        optical depths in the scene as its file has it, else 1.
    tolerance: Pixels finer than half a cell are interpolated between rays, but where they may
        change by more than this part of the image's root mean square. 0: every pixel has a ray of
        its own.
    background: Whether ambient light and environment maps are seen behind the volume.
    """

    samples_per_pixel: int = bounded(1, minimum=1, maximum=1024)
    steps_per_voxel: int | None = bounded(None, minimum=1, maximum=8, expert=True)
    tolerance: float = bounded(0.05, minimum=0, maximum=1, expert=True)
    background: bool = True

    @property
    def steps(self) -> int:
        """Samples a cell along a ray: 1 where `steps_per_voxel` is None."""
        return self.steps_per_voxel or 1


ALONG = "x", "y", "z", "xy", "xz", "yz", "xyz"


@dataclass(frozen=True)
class DiffusionSettings:
    """How light that is scattered more than once is found. [Settings](settings.md) says how to
    choose.

    model: `none` leaves such light out; `flux_limited` is the paper's for thin smoke.
    scheme: `printed` is the paper's own discretization, for comparison.
    closure: What the diffusion coefficient becomes in empty space.
    tolerance: Relative residual of a solve.
    warm_start: Whether a solve begins at the last one's solution.
    transport_rounds: Sweeps along rays that take diffusion towards the transport equation. Left
        out: 1 to 5, by the medium ([settings](settings.md#what-the-medium-chooses)).
    transport_tolerance: Rounds end where one changes light by less of it, at most
        `transport_rounds` of them, left out 16. `render.json` has how many there were, and their
        residual.
    degree: Degree to which such sweeps keep light's angles, along 44 directions, 96 for 7; of a
        single round 18 for 1, 26 for 3. Left out: by the medium.
    refine: How many times narrower cells of light are than the medium's. Left out: by the medium.
    refine_along: The axes along which cells are divided.
    halve_along: The axes along which sweeps go through halves of cells, or `none`. Left out: by the
        medium.
    receive: How many times narrower still cells are that receive light of suns. Left out: by the
        medium.
    """

    model: str = one_of("p1", ("none", "p1", "flux_limited"))
    scheme: str = one_of("conservative", ("conservative", "printed"), expert=True)
    closure: str = one_of("geometric", ("geometric", "smooth"), expert=True)
    tolerance: float = bounded(1e-4, above=0, maximum=0.5)
    warm_start: bool = bounded(True, expert=True)
    transport_rounds: int | None = bounded(None, minimum=0, maximum=16)
    transport_tolerance: float | None = bounded(None, above=0, below=1)
    degree: int | None = one_of(None, (1, 3, 5, 7))
    refine: int | None = one_of(None, (1, 3, 9), expert=True)
    refine_along: str = one_of("xyz", ALONG, expert=True)
    halve_along: str | None = one_of(None, ("none", *ALONG), expert=True)
    receive: int | None = one_of(None, (1, 3), expert=True)

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

    @property
    def halved(self) -> str:
        """The axes along which sweeps go through halves of cells, none of them ""."""
        return "" if self.halve_along in (None, "none") else str(self.halve_along)

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
    """A field from a volume file, in one of these [formats](formats.md).

    file: Relative to the scene file.
    name: The field's name in the file, where that is not its name here.
    """

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
    """Settings of one parameter; all may be left out, `{}`.

    init: Where it starts; at the scene's own value unless given.
    min: Its smallest value.
    max: Its largest value.
    tv: Weight of its total variation, which smooths a field. 1 would weigh as much as the whole
        brightness of the pictures. Unless given, 0.003 for density and emission, of whose logarithm
        it is (E11.3), three times that for an emission that is the only field, and 0 for others.
    field: Whether it differs from cell to cell, as density always does; left out: as its start.
    support: For density: where it may be above 0. `masks`: nowhere that a view sees and its mask,
        or alpha, says is empty; `auto`: nor where it is as dark as it is away from smoke, within
        noise. Left out: anywhere.
    support_margin: Pixels by which that is widened, as many as cameras may be off; 2 unless given.
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
    """In units of linear values, of which 1 is white in an sRGB file.

    read: Standard deviation of black.
    shot: Variance by radiance, of the photons that are counted.
    """

    read: float = bounded(0.0, minimum=0)
    shot: float = bounded(0.0, minimum=0)

    def violations(self) -> Iterator[Violation]:
        if self.read == self.shot == 0:
            yield "read", "no noise at all; give read or shot, or leave noise out to estimate it"


@dataclass(frozen=True)
class OptimizeSettings:
    """What `ddrecon optimize` finds, and how.

    parameters: What to find: names, as in the last table, with their settings.
    iterations: The most that are made. With `auto`, and before, a run ends by itself:
        [when to stop](settings.md#when-to-stop).
    loss: What is made small, as a mean over pixels. Unless given, `display` where pictures are sRGB
        files, `l2` where they are linear. [Settings](settings.md) says more.
    noise: How pictures err, for `loss: photon` and `ddrecon uncertainty`; estimated unless given.
    derivatives: Light that passes derivatives on: all, that scattered once, or the diffusion's.
    keep_start: The share of the fields' start that is mixed into the result, as in a film's frames.
    """

    parameters: Mapping[str, ParameterSettings]
    iterations: Iterations = bounded(AUTO, minimum=1)
    loss: str | None = one_of(None, ("l2", "l1", "huber", "relative_l2", "display", "photon"))
    noise: NoiseSettings | None = None
    derivatives: str = one_of("all", ("all", "single", "diffusion"), expert=True)
    keep_start: float = bounded(0.0, minimum=0, below=1, expert=True)
