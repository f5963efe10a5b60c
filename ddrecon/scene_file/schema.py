"""What a scene file may say: one frozen record per section, with its defaults and legal values.

Vectors are (x, y, z). A field's metadata holds the bounds `minimum`, `above`, `maximum`, `below` or
the `choices` of each number or text in it; `ALTERNATIVES` are groups of keys of which exactly one
is given; `problems` yields (key, what is wrong) for rules about several values at once. Defaults
are here and in `ddrecon.settings`, and nowhere else.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

from ddrecon.grid import Triple
from ddrecon.scene_file.camera_schema import CameraSection, Size
from ddrecon.scene_file.light_schema import Color, LightSection
from ddrecon.scene_file.phase_schema import (
    HenyeyGreensteinSection,
    PartSection,
    PhaseSection,
    Quantity,
)
from ddrecon.settings import (
    DiffusionSettings,
    FieldFile,
    NoiseSettings,
    OptimizeSettings,
    Problem,
    RenderSettings,
    bounded,
    limited,
    one_of,
    optional,
)
from ddrecon.variables.kinds import PAIRS, split_name

Count = tuple[int, int, int]
Paths = tuple[Path, ...]
Backdrop = Color | Path

MAX_CELLS = 2**30
TAKEN = re.compile(r".*\.(reduced|single|multiple|slices|gradient|[0-9]{6,})")
"""Names that output files of other views have: their components, and previews by iteration."""


BOTH = "g is the short form of a phase function: give only one of g or phase"
"""What is wrong where both are given."""


@dataclass(frozen=True)
class Constant:
    """The same value everywhere."""

    constant: float = limited(minimum=0)


Density = float | FieldFile


@dataclass(frozen=True)
class Bounds:
    """The volume's box [u]."""

    min: Triple
    max: Triple

    def problems(self) -> Iterator[Problem]:
        for axis, low, high in zip("xyz", self.min, self.max, strict=True):
            if low >= high:
                yield "max", f"{high:g} along {axis} is not above min, {low:g}"


@dataclass(frozen=True)
class VolumeSection:
    """`bounds` and `resolution` may be left out where a field's file has them."""

    ALTERNATIVES: ClassVar = PAIRS

    density: Density = limited(minimum=0)
    bounds: Bounds | None = None
    resolution: Count | None = optional(minimum=1, maximum=4096)
    sigma_a: Quantity | None = optional(minimum=0)
    sigma_s: Quantity | None = optional(minimum=0)
    sigma_t: Quantity | None = optional(minimum=0)
    albedo: Quantity | None = optional(minimum=0, maximum=1)
    g: Density = bounded(0.0, above=-1, below=1)
    phase: PhaseSection | None = None

    def problems(self) -> Iterator[Problem]:
        if self.phase is not None and self.g != 0:
            yield "phase", BOTH
        x, y, z = self.resolution or (1, 1, 1)
        if x * y * z > MAX_CELLS:
            yield "resolution", f"{x * y * z:.2g} cells are too many; at most 2^30 fit"


@dataclass(frozen=True)
class MediumSection:
    """One of the two media of a mixture; its phase function is the same in all cells."""

    ALTERNATIVES: ClassVar = PAIRS

    density: Density = limited(minimum=0)
    sigma_a: Quantity | None = optional(minimum=0)
    sigma_s: Quantity | None = optional(minimum=0)
    sigma_t: Quantity | None = optional(minimum=0)
    albedo: Quantity | None = optional(minimum=0, maximum=1)
    g: float = bounded(0.0, above=-1, below=1)
    phase: PartSection | None = None

    def problems(self) -> Iterator[Problem]:
        if self.phase is not None and self.g != 0:
            yield "phase", BOTH
        if isinstance(getattr(self.phase, "g", None), FieldFile):
            yield "phase", "the g of a medium is the same in all cells where there are two"


@dataclass(frozen=True)
class MixtureSection:
    """Two media in the same box, by name; `bounds` and `resolution` as of `VolumeSection`."""

    media: Mapping[str, MediumSection]
    bounds: Bounds | None = None
    resolution: Count | None = optional(minimum=1, maximum=4096)

    def problems(self) -> Iterator[Problem]:
        if len(self.media) != 2:
            yield "media", f"expected two media, found {len(self.media)}"
        for name in self.media:
            if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
                yield "media", f"{name!r} is no name; use letters, digits, '_' and '-'"


AnyVolume = VolumeSection | MixtureSection


@dataclass(frozen=True)
class ViewSection:
    """One view; its camera's `resolution` may be left out where there is an image.

    `weight`: how much it counts in the loss. Its picture is `exposure` times radiance plus
    `offset`; `background` is what it shows where the volume is empty.
    """

    name: str
    camera: CameraSection
    image: Path | None = None
    mask: Path | None = None
    split: str = one_of("train", ("train", "test"))
    weight: float = bounded(1.0, above=0)
    exposure: Color = bounded(1.0, minimum=1e-3)
    offset: Color = 0.0
    background: Backdrop | None = None
    noise: NoiseSettings | None = None

    def problems(self) -> Iterator[Problem]:
        if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*", self.name):
            yield (
                "name",
                f"{self.name!r} is not a file name; use letters, digits, '_', '-' and '.',"
                " the last not at its start",
            )
        if taken := TAKEN.fullmatch(self.name):
            yield "name", f"{self.name!r} ends in .{taken[1]}, as files of other views do"
        if self.image is None and self.camera.resolution is None:
            yield "camera", "missing key 'resolution'; only a view with an image can go without"


@dataclass(frozen=True)
class RingSection:
    """Cameras around `target`, the first towards +z of it and the next towards +x.

    The circle is horizontal, `height` above `target`.
    """

    count: int = limited(minimum=1, maximum=10000)
    radius: float = limited(above=0)
    fov: float = limited(above=0, below=180)
    height: float = 0.0
    target: Triple = (0.0, 0.0, 0.0)
    up: Triple = (0.0, 1.0, 0.0)
    resolution: Size | None = optional(minimum=1, maximum=16384)


@dataclass(frozen=True)
class ViewSource:
    """Views not listed one by one: of a ring, of transforms.json files, or of a COLMAP model.

    Such files are written by NeRF, instant-ngp or nerfstudio; the model is a folder.

    `images` is a glob pattern whose matches, sorted, belong to the ring's cameras in turn, or the
    folder of COLMAP's pictures. Of every `test_every` views of files that say nothing of it, the
    first is a test view.
    """

    ALTERNATIVES: ClassVar = (("ring",), ("transforms",), ("colmap",))

    ring: RingSection | None = None
    transforms: Paths | None = None
    colmap: Path | None = None
    images: str | None = None
    test_every: int | None = optional(minimum=2)

    def problems(self) -> Iterator[Problem]:
        if self.ring is not None and self.images is None and self.ring.resolution is None:
            yield "ring", "missing key 'resolution'; only views with images can go without"
        if self.transforms is not None and self.images is not None:
            yield "images", "is for a ring or COLMAP; transforms name their images themselves"
        if self.colmap is not None and self.images is None:
            yield "colmap", "missing key 'images', the folder of its pictures"
        if self.ring is not None and self.test_every is not None:
            yield (
                "test_every",
                "is for transforms and COLMAP; list the views of a ring to keep some as test views",
            )


@dataclass(frozen=True)
class SceneTree:
    """A whole scene file.

    A ring of views is already the views it stands for, and paths are absolute.
    """

    volume: AnyVolume
    lights: tuple[LightSection, ...]
    views: tuple[ViewSection, ...]
    render: RenderSettings = field(default_factory=RenderSettings)
    diffusion: DiffusionSettings = field(default_factory=DiffusionSettings)
    optimize: OptimizeSettings | None = None

    def __post_init__(self) -> None:
        parameters = self.optimize.parameters if self.optimize else {}
        named = {self.own_name(name): what for name, what in parameters.items()}
        if self.optimize and len(named) == len(parameters):
            object.__setattr__(self, "optimize", replace(self.optimize, parameters=named))

    def own_name(self, name: str) -> str:
        """`name`, or `g` for `phase.g` where both are that of Henyey and Greenstein."""
        medium, last = split_name(name)
        section: VolumeSection | MediumSection | MixtureSection | None = self.volume
        if isinstance(section, MixtureSection):
            section = section.media.get(medium.removeprefix("media.").strip("."))
        has_one = isinstance(section, VolumeSection | MediumSection) and isinstance(
            section.phase, HenyeyGreensteinSection | None
        )
        return f"{medium}g" if last == "phase.g" and has_one else name

    def problems(self) -> Iterator[Problem]:
        parameters = self.optimize.parameters if self.optimize else {}
        if len(set(map(self.own_name, parameters))) < len(parameters):
            yield "optimize", "g and phase.g are the same number: name it once"
