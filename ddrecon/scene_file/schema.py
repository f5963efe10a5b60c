"""What a scene file may say: one frozen record per section, with its defaults and legal values.

Vectors are (x, y, z). A field's metadata holds the bounds `minimum`, `above`, `maximum`, `below` or
the `choices` of each number or text in it; `ALTERNATIVES` are groups of keys of which exactly one
is given; `violations` yields (key, what is wrong) for rules about several values at once. Records
with a `type` are told apart by it, others by their first key. Defaults are here and in
`ddrecon.settings`, and nowhere else.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from operator import mul
from pathlib import Path
from typing import Any, ClassVar, Literal

from ddrecon.grid import Triple
from ddrecon.io.images.films import FILMS
from ddrecon.records import Violation, bounded, one_of
from ddrecon.settings import (
    DiffusionSettings,
    FieldFile,
    NoiseSettings,
    OptimizeSettings,
    RenderSettings,
)
from ddrecon.variables.kinds import PAIRS, PHASE, split_name

Color = float | Triple
Count = tuple[int, int, int]
Auto = Literal["auto"]
Size = tuple[int, int]
Pair = tuple[float, float]
Row = tuple[float, float, float, float]
Matrix = tuple[Row, Row, Row, Row]
Backdrop = Color | Path
Paths = Path | tuple[Path, ...]
AXES = {"choices": ("x", "y", "z"), "may_be_empty": True}

MAX_CELLS = 2**30
FRAME = re.compile(r"\{frame(:0?[1-9]?d)?\}")
"""Where the number of a frame stands in the name of a picture: `{frame:04d}`."""
TAKEN = re.compile(r".*\.(reduced|single|multiple|slices|gradient|[0-9]{6,})")
"""Names that output files of other views have: their components, and previews by iteration."""


@dataclass(frozen=True)
class Profile:
    """`values` at `heights` [u] along the volume's `up`: linear between them, even beyond."""

    heights: tuple[float, ...]
    values: tuple[Color, ...]

    def violations(self) -> Iterator[Violation]:
        if any(after <= before for before, after in pairwise(self.heights)):
            yield "heights", "must go up from one to the next"
        if len(self.values) != len(self.heights) or not self.heights:
            yield "values", f"expected one for each height, {len(self.heights)}"


@dataclass(frozen=True)
class Water:
    """What droplets of `phase` extinguish, by their liquid water; `meters`: how many a u has."""

    meters: float = bounded(above=0)


Density = float | FieldFile | Profile
Quantity = Color | FieldFile | Profile


@dataclass(frozen=True)
class HenyeyGreensteinSection:
    """`g`: mean cosine of the scattering angle."""

    type: ClassVar[str] = "henyey_greenstein"

    g: Quantity = bounded(above=-1, below=1)


@dataclass(frozen=True)
class TwoLobeSection:
    """`weight` of a Henyey-Greenstein function with the first of `g`, the rest with the second."""

    type: ClassVar[str] = "two_lobe"

    g: Pair = bounded(above=-1, below=1)
    weight: Quantity = bounded(minimum=0, maximum=1)


@dataclass(frozen=True)
class RayleighSection:
    """Particles much smaller than the wavelength, as air."""

    type: ClassVar[str] = "rayleigh"


@dataclass(frozen=True)
class TableSection:
    """Values over angle or cosine, in a file."""

    type: ClassVar[str] = "table"

    file: Path


@dataclass(frozen=True)
class MieSection:
    """Spheres whose radii follow a gamma distribution, by Mie's theory; lengths in micrometers."""

    type: ClassVar[str] = "mie"

    wavelength: Color = bounded(above=0, maximum=1e3)
    refractive_index: Color = bounded(above=1, maximum=10)
    effective_variance: float = bounded(above=0, below=0.5)
    effective_radius: float | None = bounded(None, above=0, maximum=100)


PartSection = HenyeyGreensteinSection | RayleighSection | TableSection | MieSection
PhaseSection = PartSection | TwoLobeSection


@dataclass(frozen=True)
class Bounds:
    """The volume's box [u]."""

    min: Triple
    max: Triple

    def violations(self) -> Iterator[Violation]:
        for axis, low, high in zip("xyz", self.min, self.max, strict=True):
            if low >= high:
                yield "max", f"{high:g} along {axis} is not above min, {low:g}"


@dataclass(frozen=True)
class MediumSection:
    """One of the two media of a mixture; its phase function is the same in all cells."""

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
        is_field = isinstance(getattr(self.phase, "g", None), FieldFile | Profile)
        if type(self) is MediumSection and is_field:
            yield "phase", "the g of a medium is the same in all cells where there are two"


@dataclass(frozen=True)
class VolumeSection(MediumSection):
    """`bounds` and `resolution` may be left out where a field's file has them.

    With `auto` they are what fits the pictures (`scene_file.box`).
    """

    g: Density = bounded(0.0, above=-1, below=1)  # type: ignore[assignment]
    phase: PhaseSection | None = None  # type: ignore[assignment]
    emission: Quantity | None = bounded(None, minimum=0)
    temperature: Density | None = bounded(None, minimum=0)
    effective_radius: Density | None = bounded(None, minimum=0, maximum=100)
    index: float = bounded(1.0, minimum=1, maximum=4)
    bounds: Bounds | Auto | None = None
    resolution: Count | Auto | None = bounded(None, minimum=1, maximum=4096)
    up: str = one_of("y", ("x", "y", "z"))
    periodic: tuple[str, ...] = field(default=(), metadata=AXES)

    def violations(self) -> Iterator[Violation]:
        yield from super().violations()
        if self.emission is not None and self.temperature is not None:
            yield "temperature", "says what is emitted as well: give only one of it or emission"
        x, y, z = self.resolution if isinstance(self.resolution, tuple) else (1, 1, 1)
        if x * y * z > MAX_CELLS:
            yield "resolution", f"{x * y * z:.2g} cells are too many; at most 2^30 fit"


@dataclass(frozen=True)
class MixtureSection:
    """Two media in the same box, by name; `bounds` and `resolution` as of `VolumeSection`."""

    media: Mapping[str, MediumSection]
    bounds: Bounds | Auto | None = None
    resolution: Count | Auto | None = bounded(None, minimum=1, maximum=4096)
    up: str = one_of("y", ("x", "y", "z"))
    periodic: tuple[str, ...] = field(default=(), metadata=AXES)

    def violations(self) -> Iterator[Violation]:
        if len(self.media) != 2:
            yield "media", f"expected two media, found {len(self.media)}"
        for name in self.media:
            if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
                yield "media", f"{name!r} is no name; use letters, digits, '_' and '-'"


@dataclass(frozen=True)
class GroundSection:
    """A plane at `height` [u] along the volume's `up`; `albedo`: part of light that it reflects."""

    height: float
    albedo: Color | FieldFile = bounded(minimum=0, maximum=1)


@dataclass(frozen=True)
class DirectionalSection:
    """`direction`: the way the light travels; `irradiance` on a plane facing it."""

    type: ClassVar[str] = "directional"

    direction: Triple
    irradiance: Color = bounded(minimum=0)

    def violations(self) -> Iterator[Violation]:
        if not any(self.direction):
            yield "direction", "must not be zero"


@dataclass(frozen=True)
class AmbientSection:
    """The same radiance from everywhere."""

    type: ClassVar[str] = "ambient"

    radiance: Color = bounded(minimum=0)


@dataclass(frozen=True)
class EnvironmentSection:
    """A latitude-longitude map whose pole is `up`.

    Its pixels are multiplied by `scale` and turned by `rotation` [degrees] about the pole.

    `directions`: how many directions its light on the volume is gathered into.
    """

    type: ClassVar[str] = "environment"

    file: Path
    scale: float = bounded(1.0, minimum=0)
    rotation: float = 0.0
    directions: int = bounded(48, minimum=1, maximum=1024, expert=True)
    up: str = one_of("y", ("y", "z"))


@dataclass(frozen=True)
class PointSection:
    """Light from one point, inside or outside the box; `intensity`: power per solid angle."""

    type: ClassVar[str] = "point"

    position: Triple
    intensity: Color = bounded(minimum=0)


@dataclass(frozen=True)
class BeamSection:
    """A collimated Gaussian beam from outside the box, or a pencil; `position` is on its axis."""

    type: ClassVar[str] = "beam"

    position: Triple
    direction: Triple
    power: Color = bounded(minimum=0)
    radius: float = bounded(0.0, minimum=0)

    def violations(self) -> Iterator[Violation]:
        if not any(self.direction):
            yield "direction", "must not be zero"


LightSection = DirectionalSection | AmbientSection | EnvironmentSection | PointSection | BeamSection


@dataclass(frozen=True, kw_only=True)
class PoseSection:
    """Where a camera stands, and its `resolution` (width, height) in pixels.

    The pose is `origin`, `target` and `up` [u], or `matrix`, camera to world with OpenGL axes.
    `pixel_aspect`: height of a pixel over its width.
    """

    ALTERNATIVES: ClassVar = (("matrix",), ("origin", "target", "up"))

    origin: Triple | None = None
    target: Triple | None = None
    up: Triple = (0.0, 1.0, 0.0)
    matrix: Matrix | None = None
    resolution: Size | None = bounded(None, minimum=1, maximum=16384)
    pixel_aspect: float = bounded(1.0, minimum=0.01, maximum=100)

    def violations(self) -> Iterator[Violation]:
        if self.matrix is None:
            return
        *rows, last = self.matrix
        x, y, z, _ = zip(*rows, strict=True)
        lengths = [sum(map(mul, one, one)) for one in (x, y, z)]
        across = [sum(map(mul, one, other)) for one, other in ((x, y), (y, z), (z, x))]
        volume = sum(x[i] * (y[i - 2] * z[i - 1] - y[i - 1] * z[i - 2]) for i in range(3))
        if max(abs(a - b) for a, b in zip(last, (0, 0, 0, 1), strict=True)) > 1e-4:
            yield "matrix", "its last row must be [0, 0, 0, 1]"
        elif not all(abs(error) <= 1e-4 for error in (*across, *(one - 1 for one in lengths))):
            yield (
                "matrix",
                "must be rigid: its first three columns of unit length and perpendicular",
            )
        elif volume < 0:
            yield "matrix", "must be rigid, but it mirrors (determinant -1)"


@dataclass(frozen=True)
class FisheyeSection:
    """A lens of OpenCV's fisheye model."""

    type: ClassVar[str] = "fisheye"

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0


@dataclass(frozen=True)
class OpencvSection(FisheyeSection):
    """A lens of OpenCV's model, as COLMAP and nerfstudio have it: see `ddrecon.lenses`."""

    type: ClassVar[str] = "opencv"

    p1: float = 0.0
    p2: float = 0.0


LensSection = OpencvSection | FisheyeSection


@dataclass(frozen=True, kw_only=True)
class PerspectiveSection(PoseSection):
    """`fov`: horizontal field of view [degrees] of an image this wide about its axis.

    The axis meets the image at `principal_point`, parts of its width and height from the top left.
    With `distortion`, all this is said of the pinhole camera that is left without it.
    """

    type: ClassVar[str] = "perspective"

    fov: float = bounded(above=0, below=180)
    principal_point: Pair = (0.5, 0.5)
    distortion: LensSection | None = None


@dataclass(frozen=True, kw_only=True)
class OrthographicSection(PoseSection):
    """`width` of the image [u]."""

    type: ClassVar[str] = "orthographic"

    width: float = bounded(above=0)


CameraSection = PerspectiveSection | OrthographicSection


@dataclass(frozen=True, kw_only=True)
class ViewSection:
    """One view; its camera's `resolution` may be left out where there is an image.

    `frame`: which one of films is taken, or with `frames`, which number the scene's frame 0 has
    here; of a film that begins earlier, counted from the one that it shows at its `time` [s].
    `weight`: how much it counts in the loss. Its picture is `exposure` times radiance plus
    `offset`; `background` is what it shows where the volume is empty.
    """

    name: str = ""
    camera: CameraSection
    image: Path | None = None
    mask: Path | None = None
    frame: int = 0
    time: float = bounded(0.0, minimum=0.0)
    split: str = one_of("train", ("train", "test"))
    weight: float = bounded(1.0, above=0, expert=True)
    exposure: Color = bounded(1.0, minimum=1e-3)
    offset: Color = 0.0
    background: Backdrop | None = None
    noise: NoiseSettings | None = None

    def violations(self) -> Iterator[Violation]:
        if self.name and not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*", self.name):
            yield (
                "name",
                f"{self.name!r} is not a file name; use letters, digits, '_', '-' and '.',"
                " the last not at its start",
            )
        if taken := TAKEN.fullmatch(self.name):
            yield "name", f"{self.name!r} ends in .{taken[1]}, as files of other views do"
        if self.image is None and self.camera.resolution is None:
            yield "camera", "missing key 'resolution'; only a view with an image can go without"


def split_views(views: Sequence[ViewSection], test_every: int | None) -> list[ViewSection]:
    """`views` with the first of every `test_every` as a test view, where any are."""
    return [
        replace(view, split="test") if test_every and index % test_every == 0 else view
        for index, view in enumerate(views)
    ]


@dataclass(frozen=True)
class RingSection:
    """Cameras around `target`, on a circle `height` above it about `up`, the volume's unless given.

    Where y is up, the first is towards +z and the next towards +x; where z is, +x and +y.
    """

    count: int = bounded(minimum=1, maximum=10000)
    radius: float = bounded(above=0)
    fov: float = bounded(above=0, below=180)
    height: float = 0.0
    target: Triple = (0.0, 0.0, 0.0)
    up: Triple | None = None
    resolution: Size | None = bounded(None, minimum=1, maximum=16384)

    def violations(self) -> Iterator[Violation]:
        if self.up is not None and not any(self.up):
            yield "up", "must not be zero"


@dataclass(frozen=True)
class ViewSource:
    """Views not listed one by one: of a ring, of transforms.json files, or of a COLMAP model.

    Such files are written by NeRF, instant-ngp or nerfstudio; the model is a folder.

    `images` is a glob pattern whose matches, sorted by the numbers in their names, belong to the
    ring's cameras in turn, or the folder of COLMAP's pictures. Of every `test_every` views, where
    files say nothing of it, the first is a test view.
    """

    ALTERNATIVES: ClassVar = (("ring",), ("transforms",), ("colmap",))

    ring: RingSection | None = None
    transforms: Paths | None = None
    colmap: Path | None = None
    images: str | None = None
    test_every: int | None = bounded(None, minimum=2)

    def violations(self) -> Iterator[Violation]:
        if self.ring is not None and self.images is None and self.ring.resolution is None:
            yield "ring", "missing key 'resolution'; only views with images can go without"
        if self.transforms is not None and self.images is not None:
            yield "images", "is for a ring or COLMAP; transforms name their images themselves"
        if self.colmap is not None and self.images is None:
            yield "colmap", "missing key 'images', the folder of its pictures"


@dataclass(frozen=True)
class FramesSection:
    """A film: pictures and masks are films, or have `{frame:04d}` in their names.

    `calibrate`: how many frames, spread along it, find together what does not change; with 0 each
    frame finds its own.
    """

    first: int = bounded(minimum=0)
    last: int = bounded(minimum=0)
    step: int = bounded(1, minimum=1)
    calibrate: int = bounded(3, minimum=0)

    @property
    def numbers(self) -> range:
        """The numbers of the frames."""
        return range(self.first, self.last + 1, self.step)

    def violations(self) -> Iterator[Violation]:
        if self.last < self.first:
            yield "last", f"{self.last} comes before the first frame, {self.first}"


@dataclass(frozen=True)
class SceneTree:
    """A whole scene file: rings and such are the views they stand for, and paths are absolute."""

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
        others = [pair for pair in PAIRS if last not in pair]
        if len(others) == 1:
            names |= {medium + other for other in others[0]}
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
        given = (getattr(self.volume, name, None) for name in ("emission", "temperature"))
        return any(one not in (None, 0, (0, 0, 0)) for one in given) or self.may_change("emission")

    def violations(self) -> Iterator[Violation]:
        if not self.lights and not self.glows:
            yield "lights", "there is none, and the volume has no emission"
        for name in self.optimize.parameters if self.optimize else ():
            medium, last = split_name(name)
            section = self.media.get(medium.removeprefix("media.").strip("."))
            has_one = section and isinstance(section.phase, HenyeyGreensteinSection | None)
            if last == "phase.g" and has_one:
                yield "optimize", f"parameters.{name} is called {medium}g here"
        named = [str(path) for view in self.views for path in (view.image, view.mask) if path]
        counted = [name for name in named if FRAME.search(name)]
        if counted and self.frames is None:
            yield "views", f"{counted[0]} is of a film; say which frames: {{first: 0, last: 99}}"
        films = [name for name in named if name.lower().endswith(tuple(FILMS))]
        if self.frames is not None and not counted and not films:
            yield "frames", "no picture changes: name films, or put {frame:04d} into names"
