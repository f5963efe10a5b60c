"""What a scene file may say of a camera: its pose, its image and its lens.

As `ddrecon.scene_file.schema` does of everything else.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from operator import mul
from typing import ClassVar

from ddrecon.grid import Triple
from ddrecon.settings import Problem, bounded, limited, optional

Size = tuple[int, int]
Pair = tuple[float, float]
Row = tuple[float, float, float, float]
Matrix = tuple[Row, Row, Row, Row]


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
    resolution: Size | None = optional(minimum=1, maximum=16384)
    pixel_aspect: float = bounded(1.0, minimum=0.01, maximum=100)

    def problems(self) -> Iterator[Problem]:
        if self.matrix is not None:
            yield from _rigidity(self.matrix)


def _rigidity(matrix: Matrix) -> Iterator[Problem]:
    """Why `matrix` is no rotation and shift, where it is not."""
    *rows, last = matrix
    *axes, _ = zip(*rows, strict=True)
    products = [sum(map(mul, axes[i], axes[j])) - (i == j) for i in range(3) for j in range(i, 3)]
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = axes
    if max(abs(a - b) for a, b in zip(last, (0, 0, 0, 1), strict=True)) > 1e-4:
        yield "matrix", "its last row must be [0, 0, 0, 1]"
    elif not all(abs(product) <= 1e-4 for product in products):
        yield (
            "matrix",
            "must be rigid, but its first three columns are not of unit length and perpendicular",
        )
    elif ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx) < 0:
        yield "matrix", "must be rigid, but it mirrors (determinant -1)"


@dataclass(frozen=True)
class OpencvSection:
    """A lens of OpenCV's model, as COLMAP and nerfstudio have it: see `ddrecon.lenses`."""

    type: ClassVar[str] = "opencv"

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0


@dataclass(frozen=True)
class FisheyeSection:
    """A lens of OpenCV's fisheye model."""

    type: ClassVar[str] = "fisheye"

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0


LensSection = OpencvSection | FisheyeSection


@dataclass(frozen=True, kw_only=True)
class PerspectiveSection(PoseSection):
    """`fov`: horizontal field of view [degrees] of an image this wide about its axis.

    The axis meets the image at `principal_point`, parts of its width and height from the top left.
    With `distortion`, all this is said of the pinhole camera that is left without it.
    """

    type: ClassVar[str] = "perspective"

    fov: float = limited(above=0, below=180)
    principal_point: Pair = (0.5, 0.5)
    distortion: LensSection | None = None


@dataclass(frozen=True, kw_only=True)
class OrthographicSection(PoseSection):
    """`width` of the image [u]."""

    type: ClassVar[str] = "orthographic"

    width: float = limited(above=0)


CameraSection = PerspectiveSection | OrthographicSection
