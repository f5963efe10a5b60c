"""What a scene file may say of views and cameras, as `schema` has the rest of it."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import mul
from pathlib import Path
from typing import ClassVar

from ddrecon.grid import Triple
from ddrecon.records import Violation, bounded, one_of
from ddrecon.settings import MOST_AROUND

Color = float | Triple
Size = tuple[int, int]
Pair = tuple[float, float]
Row = tuple[float, float, float, float]
Matrix = tuple[Row, Row, Row, Row]
Backdrop = Color | Path
Paths = Path | tuple[Path, ...]

FRAME = re.compile(r"\{frame(:0?[1-9]?d)?\}")
"""Where the number of a frame stands in the name of a picture: `{frame:04d}`."""
TAKEN = re.compile(r".*\.(reduced|single|multiple|transmittance|depth|slices|gradient|[0-9]{6,})")
"""Names that output files of other views have: their components, and previews by iteration."""


@dataclass(frozen=True, kw_only=True)
class PoseSection:
    """Where a camera stands, and its pixels.

    origin: Where the camera stands [u].
    target: A point on its axis [u].
    up: The direction that is up in the image.
    matrix: Camera to world, with OpenGL axes: the columns are right, up, backward and origin.
    resolution: Width and height in pixels; left out where the view has an image.
    pixel_aspect: Height of a pixel over its width.
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
        products = [sum(map(mul, first, second)) for first in (x, y, z) for second in (x, y, z)]
        volume = sum(x[i] * (y[i - 2] * z[i - 1] - y[i - 1] * z[i - 2]) for i in range(3))
        if not _is_close(last, (0, 0, 0, 1)):
            yield "matrix", "its last row must be [0, 0, 0, 1]"
        elif not _is_close(products, (1, 0, 0, 0, 1, 0, 0, 0, 1)):
            rule = "its first three columns of unit length and perpendicular"
            yield "matrix", f"must be rigid: {rule}"
        elif volume < 0:
            yield "matrix", "must be rigid, but it mirrors (determinant -1)"


def _is_close(numbers: Sequence[float], expected: Sequence[float]) -> bool:
    return all(abs(a - b) <= 1e-4 for a, b in zip(numbers, expected, strict=True))


@dataclass(frozen=True)
class FisheyeSection:
    """A fisheye as OpenCV and COLMAP calibrate it.

    k1, k2, k3, k4: Of the angle's powers 3, 5, 7 and 9 in turn.
    """

    type: ClassVar[str] = "fisheye"
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0


@dataclass(frozen=True)
class OpencvSection(FisheyeSection):
    """A lens as OpenCV and COLMAP calibrate it, with nerfstudio's k4. Everything else that is said
    of the camera holds for the pinhole that would be left.

    k1, k2, k3, k4: Radial: of r^2, r^4, r^6 and r^8 in turn.
    p1, p2: Tangential.
    """

    type: ClassVar[str] = "opencv"
    p1: float = 0.0
    p2: float = 0.0


LensSection = OpencvSection | FisheyeSection


@dataclass(frozen=True, kw_only=True)
class PerspectiveSection(PoseSection):
    """A pinhole camera. Give either `origin`, `target` and `up`, or `matrix`.

    fov: Horizontal field of view, in degrees.
    principal_point: Where the axis meets the image, in parts of its size from the top left.
    distortion: Of its lens; see below. Left out, there is none.
    """

    type: ClassVar[str] = "perspective"
    fov: float = bounded(above=0, below=180)
    principal_point: Pair = (0.5, 0.5)
    distortion: LensSection | None = None


@dataclass(frozen=True, kw_only=True)
class OrthographicSection(PoseSection):
    """Parallel rays, as a satellite far away sees.

    width: Of the image [u].
    """

    type: ClassVar[str] = "orthographic"
    width: float = bounded(above=0)


CameraSection = PerspectiveSection | OrthographicSection


@dataclass(frozen=True, kw_only=True)
class ViewSection:
    """A list of pictures, or of cameras to render. Or a ring, or NeRF cameras: see the next table.

    name: Files of the view have this name.
    camera: Where it is seen from; see below.
    image: The picture: .exr, .hdr, .npy and float .tif are linear, .png, .jpg, .webp and films
        (.mp4, .mov, .mkv, .webm) are decoded from sRGB; alpha 0 is empty.
    mask: A picture of the same size, white where pixels count, else black.
    frame: Of a film, the frame that is taken, from 0; with `frames`, that of the scene's frame 0.
    time: Seconds after which a film begins here: `frame` counts from there.
    split: `test` views are never optimized on, and always reported.
    weight: How much a training view counts.
    exposure: The picture is this times radiance. As a parameter, its mean over views is held.
    offset: And this is added: a black level, or haze of the lens.
    background: What the picture shows where the volume is empty: a picture without it, or a color.
        Unless given, the lights behind it, or black.
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

    def violations(self) -> Iterator[Violation]:
        if self.name and not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{,199}", self.name):
            legal = "use letters, digits, '_', '-' and '.', up to 200, not '.' first"
            yield "name", f"{self.name!r} is not a file name; {legal}"
        if match := TAKEN.fullmatch(self.name):
            yield "name", f"{self.name!r} ends in .{match[1]}, as files of other views do"
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
    """Cameras around `target` about `volume.up`: where y is up, the first towards +z of it, the
    next towards +x. Where z is up they are +x and +y.

    count: How many.
    radius: Of the circle [u].
    fov: Horizontal field of view, in degrees.
    height: Of the circle above the target [u].
    target: What they look at [u].
    resolution: Width and height in pixels; left out where there are images.
    """

    count: int = bounded(minimum=1, maximum=MOST_AROUND)
    radius: float = bounded(above=0)
    fov: float = bounded(above=0, below=180)
    height: float = 0.0
    target: Triple = (0.0, 0.0, 0.0)
    resolution: Size | None = bounded(None, minimum=1, maximum=16384)


@dataclass(frozen=True)
class ViewSource:
    """Views that are not listed one by one.

    ring: Cameras in a circle; see below.
    transforms: `transforms.json` of NeRF, instant-ngp or nerfstudio, read as it is.
    colmap: Folder of COLMAP's sparse model, such as `sparse/0`; text or binary.
    images: For a ring: a pattern such as `targets/train_*.exr`, whose files, sorted by the numbers
        in their names, belong to the cameras in turn. For COLMAP: the folder of its pictures.
    test_every: The first of so many views is a test view, where transforms do not say which are.
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
    """A [film](films.md): pictures and masks are films, or have the number of a frame in their
    names, `front_{frame:04d}.png`. Other commands than `optimize` take its first frame.

    first: Number of the first frame.
    last: Number of the last frame.
    step: From one frame to the next.
    calibrate: Frames, spread along the film, that find all but fields together. 0: none.
    fps: Frames a second: exported velocities are per second, without it per frame.
    """

    first: int = bounded(minimum=0)
    last: int = bounded(minimum=0)
    step: int = bounded(1, minimum=1)
    calibrate: int = bounded(3, minimum=0)
    fps: float | None = bounded(None, above=0)

    @property
    def numbers(self) -> range:
        """The numbers of the frames."""
        return range(self.first, self.last + 1, self.step)

    def violations(self) -> Iterator[Violation]:
        if self.last < self.first:
            yield "last", f"{self.last} comes before the first frame, {self.first}"
