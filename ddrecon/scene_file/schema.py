"""What a scene file may say: a frozen record for each section, with its defaults and legal values.

A record's docstring explains the section, and each key in a line `key: sentence`: the manual and
the JSON schema are made of these by docs/make_scene_file.py. Vectors are (x, y, z). A field's
metadata holds the bounds or `choices` of each number or text in it; `ALTERNATIVES` are groups of
keys of which exactly one is given; `violations` yields (key, what is wrong) for rules about several
values at once. Records with a `type` are told apart by it, others by their first required key.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Literal

from ddrecon.grid import Triple
from ddrecon.io.images.films import FILMS
from ddrecon.records import Violation, bounded, one_of
from ddrecon.scene_file.view_schema import FRAME, Color, FramesSection, ViewSection, ViewSource
from ddrecon.settings import DiffusionSettings, FieldFile, OptimizeSettings, RenderSettings
from ddrecon.variables.kinds import PAIRS, PHASE, split_name

Count = tuple[int, int, int]
Auto = Literal["auto"]
Pair = tuple[float, float]
AXES = {"choices": ("x", "y", "z"), "may_be_empty": True}

MAX_CELLS = 2**30


@dataclass(frozen=True)
class Water:
    """Of droplets, `phase: {type: mie, ...}`: 1.5 / effective radius [micrometers] per meter, twice
    their cross section. `density` is then their liquid water [g/m3].

    meters: How many a u has: 1000 where lengths are in kilometers.
    """

    meters: float = bounded(above=0)


@dataclass(frozen=True)
class ByLabel:
    """Values by the label of each cell, as segmentations of tissue have them.

    labels: A volume file of whole numbers, from 0.
    table: A value for each label.
    name: The field's name in the file, where that is not `labels`.
    """

    labels: Path
    table: tuple[Color, ...]
    name: str = "labels"


@dataclass(frozen=True)
class ByHeight:
    """Values by height, such as those of a gas; `media` has how air stands beside a cloud.

    heights: Along `volume.up` [u], each above the one before.
    values: One at each height; linear between them, and even beyond.
    """

    heights: tuple[float, ...]
    values: tuple[Color, ...]

    def violations(self) -> Iterator[Violation]:
        if any(after <= before for before, after in pairwise(self.heights)):
            yield "heights", "must go up from one to the next"
        if len(self.values) != len(self.heights) or not self.heights:
            yield "values", f"expected one for each height, {len(self.heights)}"


ByCell = FieldFile | ByHeight | ByLabel
Density = float | ByCell
Quantity = Color | ByCell


@dataclass(frozen=True)
class HenyeyGreensteinSection:
    """The usual phase function of one number; `g: 0.3` is short for it.

    g: Mean cosine of the scattering angle; above 0 is forward. A file has one a cell.
    """

    type: ClassVar[str] = "henyey_greenstein"
    g: Quantity = bounded(above=-1, below=1)


@dataclass(frozen=True)
class TwoLobeSection:
    """A mixture of two Henyey-Greenstein functions: haze and smoke, which scatter backward too.

    g: The mean cosine of each.
    weight: The part of the first; a file has one a cell.
    """

    type: ClassVar[str] = "two_lobe"
    g: Pair = bounded(above=-1, below=1)
    weight: Quantity = bounded(minimum=0, maximum=1)


@dataclass(frozen=True)
class RayleighSection:
    """Air, and other particles much smaller than the wavelength.

    It has no numbers.
    """

    type: ClassVar[str] = "rayleigh"


@dataclass(frozen=True)
class TableSection:
    """Values over the angle, of any scale; see [your data](your_data.md#phase-functions).

    file: .csv or .txt with a header: `angle` (degrees) or `cosine`, then one column of values or
        one a color.
    """

    type: ClassVar[str] = "table"
    file: Path


@dataclass(frozen=True)
class MieSection:
    """Droplets whose radii follow a gamma distribution, by Mie's theory. Needs miepython: `pip
    install "ddrecon[mie]"`.

    wavelength: In micrometers, one for each color.
    refractive_index: Of the droplets; of water 1.33.
    effective_radius: In micrometers: of clouds 5 to 15; or `volume.effective_radius`.
    effective_variance: Of the distribution: of clouds about 0.1.
    """

    type: ClassVar[str] = "mie"
    wavelength: Color = bounded(above=0, maximum=1e3)
    refractive_index: Color = bounded(above=1, maximum=10)
    effective_variance: float = bounded(above=0, below=0.5)
    effective_radius: float | None = bounded(None, above=0, maximum=100)


PartSection = HenyeyGreensteinSection | RayleighSection | TableSection | MieSection
PhaseSection = PartSection | TwoLobeSection


@dataclass(frozen=True)
class Bounds:
    """The volume's box.

    min, max: Its corners [u].
    """

    min: Triple
    max: Triple

    def violations(self) -> Iterator[Violation]:
        for axis, low, high in zip("xyz", self.min, self.max, strict=True):
            if low >= high:
                yield "max", f"{high:g} along {axis} is not above min, {low:g}"


@dataclass(frozen=True)
class MediumSection:
    """One of them, as a volume of one medium is. Give either `sigma_a` and `sigma_s`, or `sigma_t`
    and `albedo`.

    density: What scatters and absorbs, per cell: a factor of all else. `{constant: 1}` is `1`.
    sigma_a: Absorption coefficient per unit of density [1/u].
    sigma_s: Scattering coefficient per unit of density [1/u].
    sigma_t: Extinction coefficient per unit of density [1/u]: absorption and scattering together.
    albedo: Single-scattering albedo: the part of the extinction that scatters.
    g: Mean cosine of the scattering angle (asymmetry parameter) of the Henyey-Greenstein phase
        function; above 0 is forward. The short form of `phase`.
    phase: Any but `two_lobe`; its numbers are the same in all cells.
    """

    ALTERNATIVES: ClassVar = PAIRS

    density: Density = bounded(minimum=0)
    sigma_a: Quantity | None = bounded(None, minimum=0)
    sigma_s: Quantity | None = bounded(None, minimum=0)
    sigma_t: Quantity | Water | None = bounded(None, minimum=0)
    albedo: Quantity | None = bounded(None, minimum=0, maximum=1)
    g: float = bounded(0.0, above=-1, below=1)
    phase: PartSection | None = None

    def violations(self) -> Iterator[Violation]:
        if self.phase is not None and self.g != 0:
            yield "phase", "g is short for a phase function: give only one of g or phase"
        by_cell = getattr(self, "effective_radius", None)
        if not isinstance(self.phase, MieSection):
            if isinstance(self.sigma_t, Water):
                yield "sigma_t", "meters are for droplets, phase: {type: mie, ...}"
            if by_cell is not None:
                yield "effective_radius", "is that of droplets, phase: {type: mie, ...}"
        elif (by_cell is None) == (self.phase.effective_radius is None):
            yield "phase", "give droplets one effective_radius: here, or volume.effective_radius"
        is_field = isinstance(getattr(self.phase, "g", None), ByCell)
        if type(self) is MediumSection and is_field:
            yield "phase", "the g of a medium is the same in all cells where there are two"


@dataclass(frozen=True, kw_only=True)
class BoxSection:
    """The box, and how it lies.

    bounds: The corners of the box [u], `{min: [x, y, z], max: [x, y, z]}`; of the field's file
        where left out. `auto`: what fits the pictures.
    resolution: Cells along x, y and z; left out: those of the file; `auto`: cubes two pixels
        wide, or as wide as four million of them are, for which the box may grow, but not along its
        period.
    up: The axis along which `heights`, a `ground` and rings count, and which `export --up` turns.
    periodic: The axes, one or two, along which the volume repeats without end, as `[x, z]`
        ([E2.15](theory.md#2-the-forward-model)). Lights are directional, ambient or maps; the
        diffusion is `p1` by the scheme `conservative`, or none.
    """

    bounds: Bounds | Auto | None = None
    resolution: Count | Auto | None = bounded(None, minimum=1, maximum=4096)
    up: str = one_of("y", ("x", "y", "z"))
    periodic: tuple[str, ...] = field(default=(), metadata=AXES)

    def violations(self) -> Iterator[Violation]:
        x, y, z = self.resolution if isinstance(self.resolution, tuple) else (1, 1, 1)
        if x * y * z > MAX_CELLS:
            yield "resolution", f"{x * y * z:.2g} cells are too many; at most 2^30 fit"


@dataclass(frozen=True)
class VolumeSection(MediumSection, BoxSection):
    """The box, and what is in it. Give either `sigma_a` and `sigma_s`, or `sigma_t` and `albedo`.

    phase: How light is scattered by angle, in place of `g`; see below.
    effective_radius: Of droplets, `phase: {type: mie, ...}`, where it differs by cell
        [micrometers]: mixtures of the smallest and the largest; 0 where there are none.
    emission: Radiance that a unit of length emits [radiance/u], whatever the density. As a
        parameter that starts from 0 it is a field, one number a color.
    temperature: In place of `emission`, of a black body [K]: absorption times its radiance, of
        luminance 1 at 1500 K ([E2.11](theory.md#2-the-forward-model)).
    index: Refractive index inside the box, whose flat faces refract and reflect light; outside it
        is 1. Not with a period, a ground, point lights or cameras inside.
    """

    g: Density = bounded(0.0, above=-1, below=1)  # type: ignore[assignment]
    phase: PhaseSection | None = None  # type: ignore[assignment]
    emission: Quantity | None = bounded(None, minimum=0)
    temperature: Density | None = bounded(None, minimum=0)
    effective_radius: Density | None = bounded(None, minimum=0, maximum=100)
    index: float = bounded(1.0, minimum=1, maximum=4)

    def violations(self) -> Iterator[Violation]:
        yield from MediumSection.violations(self)
        if self.emission is not None and self.temperature is not None:
            yield "temperature", "says what is emitted as well: give only one of it or emission"
        yield from BoxSection.violations(self)


@dataclass(frozen=True)
class MixtureSection(BoxSection):
    """Two media in the same box, in place of `density`, sections and `phase`. Their parameters are
    `media.NAME.density` and so on.

    media: Two media by names of your choice; see below.
    """

    media: Mapping[str, MediumSection]

    def violations(self) -> Iterator[Violation]:
        yield from super().violations()
        if len(self.media) != 2:
            yield "media", f"expected two media, found {len(self.media)}"
        for name in self.media:
            if not re.fullmatch(r"[A-Za-z0-9_-]{1,200}", name):
                yield "media", f"{name!r} is no name; use up to 200 letters, digits, '_' and '-'"


@dataclass(frozen=True)
class GroundSection:
    """An unbounded plane under the box that reflects light evenly into all directions. Cameras see
    it, in shadow and in the light of the volume, and it lights the volume.

    height: Along `volume.up` [u]: at the bottom of the box, or below.
    albedo: The part of the light that it reflects; `ground.albedo` can be optimized. A file is a
        picture, or `.npy`, of what is straight under the box, `[z, x]` (`[y, x]` with `up: z`) from
        low to high as in volume files; beyond it is its mean.
    """

    height: float
    albedo: Color | FieldFile = bounded(minimum=0, maximum=1)


@dataclass(frozen=True)
class DirectionalSection:
    """Parallel light, such as the sun's.

    direction: The direction in which the light travels, of any length.
    irradiance: On a plane that faces it, in units of radiance times steradian.
    """

    type: ClassVar[str] = "directional"
    direction: Triple = bounded(is_nonzero=True)
    irradiance: Color = bounded(minimum=0)


@dataclass(frozen=True)
class AmbientSection:
    """The same light from everywhere.

    radiance: Of every direction.
    """

    type: ClassVar[str] = "ambient"
    radiance: Color = bounded(minimum=0)


@dataclass(frozen=True)
class EnvironmentSection:
    """A latitude-longitude map (HDRI), oriented as Mitsuba's `envmap`. Small bright regions become
    suns.

    file: An image of linear radiance: .exr, .hdr, .npy, .tif.
    scale: Factor on its pixels.
    rotation: About the pole, in degrees.
    directions: Directions into which its light is gathered; more are slower and more exact.
    up: Where the pole is, the map's first row. With z, what the map holds at (x, y, z) is at (x,
        -z, y).
    """

    type: ClassVar[str] = "environment"
    file: Path
    scale: float = bounded(1.0, minimum=0)
    rotation: float = 0.0
    directions: int = bounded(48, minimum=1, maximum=1024, expert=True)
    up: str = one_of("y", ("y", "z"))


@dataclass(frozen=True)
class PointSection:
    """Light from a point, inside or outside the box.

    position: Where it is [u].
    intensity: Power per solid angle.
    """

    type: ClassVar[str] = "point"
    position: Triple
    intensity: Color = bounded(minimum=0)


@dataclass(frozen=True)
class BeamSection:
    """A collimated Gaussian beam, such as a laser's, that comes from outside the box.

    position: A point on its axis [u]; where on it does not matter.
    direction: The direction in which it travels, of any length.
    power: Of the whole beam.
    radius: Where irradiance is 1/e^2 of that on the axis [u]. 0 is a pencil: its radius is half the
        longest side of a cell, and no beam is thinner.
    """

    type: ClassVar[str] = "beam"
    position: Triple
    direction: Triple = bounded(is_nonzero=True)
    power: Color = bounded(minimum=0)
    radius: float = bounded(0.0, minimum=0)


LightSection = DirectionalSection | AmbientSection | EnvironmentSection | PointSection | BeamSection


@dataclass(frozen=True)
class SceneTree:
    """A whole scene file: rings and such are the views they stand for, and paths are absolute.

    volume: The box, and what is in it.
    lights: A list of lights.
    views: A list of pictures, or of cameras to render.
    render: How view rays are sampled.
    diffusion: How light that is scattered more than once is found.
    optimize: What is found, and how.
    frames: Which pictures of films there are.
    ground: A plane under the box.
    """

    volume: VolumeSection | MixtureSection
    lights: tuple[LightSection, ...] = field(metadata={"may_be_empty": True})
    views: tuple[ViewSection, ...] = field(metadata={"also": (ViewSource,)})
    render: RenderSettings = field(default_factory=RenderSettings)
    diffusion: DiffusionSettings = field(default_factory=DiffusionSettings)
    optimize: OptimizeSettings | None = None
    frames: FramesSection | None = None
    ground: GroundSection | None = None

    @property
    def media(self) -> Mapping[str, VolumeSection | MediumSection]:
        """The sections of media by name, "" where there is one medium."""
        return {"": self.volume} if isinstance(self.volume, VolumeSection) else self.volume.media

    def may_change(self, name: str) -> bool:
        """Whether the variable `name` is optimized, or follows from others that are."""
        medium, last = split_name(name)
        names = {name, medium + last.removeprefix(PHASE)}
        for pair, equivalent in (PAIRS, PAIRS[::-1]):
            names |= {medium + sigma for sigma in equivalent} if last in pair else set()
        return not names.isdisjoint(self.optimize.parameters if self.optimize else ())

    def share_color(self, name: str, value: Any) -> Any:
        """One number for the color `value` of the variable `name` if its three are equal.

        Light of one color is then computed once. What is optimized keeps its three.
        """
        is_equal = isinstance(value, tuple) and len(value) == 3 and len(set(value)) == 1
        return value[0] if is_equal and not self.may_change(name) else value

    @property
    def glows(self) -> bool:
        """Whether the volume emits light, or may come to."""
        sources = (getattr(self.volume, name, None) for name in ("emission", "temperature"))
        is_bright = any(source not in (None, 0, (0, 0, 0)) for source in sources)
        return is_bright or self.may_change("emission")

    def violations(self) -> Iterator[Violation]:
        if not self.lights and not self.glows:
            yield "lights", "there is none, and the volume has no emission"
        named = [str(path) for view in self.views for path in (view.image, view.mask) if path]
        counted = [name for name in named if FRAME.search(name)]
        if counted and self.frames is None:
            yield "views", f"{counted[0]} is of a film; say which frames: {{first: 0, last: 99}}"
        films = [name for name in named if name.lower().endswith(tuple(FILMS))]
        if self.frames is not None and not counted and not films:
            yield "frames", "no picture changes: name films, or put {frame:04d} into names"
