"""Cameras: which world ray belongs to which pixel.

Row 0 of an image is its top; +x of the image is to the right of someone looking from origin to
target with `up` up. World vectors here are (x, y, z); `cast_rays` hands them on in array order.

A lens moves where light from a direction meets the image. Directions are places (x right, y down)
on the plane one unit in front of the camera, as OpenCV has them, and so are places in the image,
once the principal point is taken off and the focal length divided out. Both models are written as
OpenCV, COLMAP and nerfstudio write them:

- `opencv` moves a place u at distance r from the axis to
  u (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8), plus
  (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y)
  (Brown 1966; k4 as in nerfstudio);
- `fisheye` moves a direction at angle t from the axis to the distance
  t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) from it (Kannala and Brandt 2006,
  doi:10.1109/TPAMI.2006.153).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid, Triple, array_order
from ddrecon.records import bounded, one_of
from ddrecon.settings import LENSES

CELL = 2.0
"""How many pixels wide a cell is best: finer pictures show no more of it."""
NEWTON_STEPS = 12
"""Steps of Newton's method that find a view ray through a pane to rounding."""
MOST_STEPS = 50
"""Newton steps at most; three or four are enough for any lens that is sold."""


@dataclass(eq=False)
class Camera:
    """A perspective or orthographic camera.

    `pose`: the rigid camera-to-world matrix `[3, 4]`, with OpenGL axes (right, up, backward,
    origin). `size`: (height, width) in pixels. `half_width`: tangent of half the horizontal field
    of view, or half the width of an orthographic image [u]. `principal_point`: where the axis meets
    the image, in widths and heights from the top left. `pixel_aspect`: the height of a pixel over
    its width. `lens`: that of `ddrecon.lenses` of a perspective camera, whose coefficients are
    `distortion`; None is a pinhole. What is varied is a tensor: [] for `half_width`, [2] for
    `principal_point`.
    """

    pose: Tensor
    size: tuple[int, int] = bounded(minimum=1)
    half_width: float | Tensor  # type: ignore[misc]  # it has no default, as `size` has none
    is_perspective: bool = True
    principal_point: tuple[float, float] | Tensor = (0.5, 0.5)
    pixel_aspect: float = bounded(1.0, above=0)
    lens: str | None = one_of(None, LENSES)
    distortion: Tensor | None = None

    def __setattr__(self, name: str, value: Any) -> None:
        is_plain = name in ("size", "principal_point") and not isinstance(value, Tensor)
        super().__setattr__(name, tuple(value) if is_plain else value)  # lists cannot be hashed

    @property
    def tensors(self) -> list[Tensor]:
        """All numbers that may be varied and are tensors, the pose first."""
        optics = self.half_width, self.principal_point, self.distortion
        return [self.pose, *(value for value in optics if isinstance(value, Tensor))]

    def resize(self, factor: int) -> Camera:
        """The same view with `factor` times fewer pixels along each side (at least one)."""
        height, width = (max(1, side // factor) for side in self.size)
        aspect = self.pixel_aspect * (self.size[0] * width) / (self.size[1] * height)
        return replace(self, size=(height, width), pixel_aspect=aspect)


def twist(camera: Camera, change: Tensor, pivot: Triple) -> Camera:
    """`camera` turned about `pivot` (x, y, z), then shifted.

    `change` [6]: a rotation vector [rad] and a shift [u], both in the camera's own axes (right, up,
    backward). With the pivot amid what the camera looks at, the effects of both can be told apart.
    """
    axes, origin = camera.pose[:, :3], camera.pose[:, 3]
    center = origin.new_tensor(pivot)
    turn = axes @ rotation(change[:3]) @ axes.T
    moved = center + turn @ (origin - center) + axes @ change[3:]
    return replace(camera, pose=torch.cat([turn @ axes, moved[:, None]], 1))


def rotation(vector: Tensor) -> Tensor:
    """The matrix [3, 3] of the right-handed rotation by |vector| [rad] about `vector` (x, y, z).

    Rodrigues' formula, I + (sin a / a) K + (sin (a / 2) / (a / 2))^2 / 2 K^2 with a = |vector| and
    K the cross product by `vector`.
    """
    axes = torch.eye(3, dtype=vector.dtype, device=vector.device)
    turns, cross = vector.norm() / math.pi, torch.linalg.cross(axes, vector.expand(3, 3))
    return axes + torch.sinc(turns) * cross + 0.5 * torch.sinc(turns / 2) ** 2 * cross @ cross


@dataclass(frozen=True)
class Pane:
    """A plane across an array `axis` at `place` [u]; beyond it the refractive index is `index`."""

    axis: int
    place: float
    index: float

    def bend(self, eye: Tensor, away: Sequence[Tensor]) -> list[Tensor]:
        """The directions (z, y, x), of any length, to an `eye` before the pane from points `away`
        from the eye, behind it.

        With t the tangent of the angle before the pane, at the heights H and d before and behind
        it, Snell's law has the distance across as H t + d t / sqrt(n^2 + (n^2 - 1) t^2).
        """
        before = (eye[self.axis] - self.place).abs()
        behind = away[self.axis].abs() - before
        square = sum(along**2 for axis, along in enumerate(away) if axis != self.axis)
        excess, squared = (self.index**2 - 1) * square, self.index**2
        # Newton's method for t over the distance: from 0 up, and it never comes beyond.
        tangent = torch.zeros_like(square + behind)
        for step in range(NEWTON_STEPS):
            # The last step's derivative is that of the implicit function.
            with torch.set_grad_enabled(torch.is_grad_enabled() and step == NEWTON_STEPS - 1):
                root = (squared + excess * tangent**2).sqrt()
                slope = (before + behind * squared / root**3).detach()
                tangent = tangent - ((before + behind / root) * tangent - 1) / slope
        inside = tangent / (squared + excess * tangent**2).sqrt()
        side = away[self.axis].sign()
        return [-side if axis == self.axis else -inside * along for axis, along in enumerate(away)]


@dataclass(frozen=True)
class Rays:
    """View rays, in array order.

    `origin` [R, 3] in u; `direction` [R, 3], of unit length, away from the camera; `eye` [3]: what
    all rays of a perspective camera pass through, None for parallel rays; `pane`: of a box that
    refracts light, the face through which rays have come in.
    """

    origin: Tensor
    direction: Tensor
    eye: Tensor | None
    pane: Pane | None = None

    def select(self, index: Tensor) -> Rays:
        """The rays at `index`."""
        return Rays(self.origin[index], self.direction[index], self.eye, self.pane)

    def towards_eye(self, grid: Grid) -> tuple[Tensor, Tensor, Tensor]:
        """Unit directions from the cells of `grid` to the camera: z, y, x, each for `[z, y, x]`.

        They are those of all rays through cells' centers, so light along them is a field.
        """
        if self.eye is None:
            z, y, x = -self.direction[0]
            return z, y, x
        z, y, x = (e - c for e, c in zip(self.eye, grid.centers(self.eye), strict=True))
        if self.pane is not None:
            z, y, x = self.pane.bend(self.eye, [-z, -y, -x])
        distance = (z**2 + y**2 + x**2).sqrt().clamp(min=torch.finfo(self.eye.dtype).tiny)
        return z / distance, y / distance, x / distance


def pixel_width(camera: Camera, place: Tensor, least: float) -> float:
    """How wide [u] a pixel of `camera` is at `place` (x, y, z), or at `least` so far [u] away."""
    width = 2 * float(camera.half_width) / camera.size[1]
    distance = float(camera.pose[:, 3].cpu().dist(place.to(camera.pose.dtype)))
    return width * max(distance, least) if camera.is_perspective else width


def cell_width(grid: Grid, camera: Camera) -> float:
    """How many pixels of `camera` a cell in the middle of `grid` is wide, along its shortest side.

    A width of `CELL` fits pictures best. A camera within the box sees cells as from a face of it.
    """
    nearest = min(grid.extent) / 2
    return min(grid.spacing) / pixel_width(camera, torch.tensor(grid.center_xyz), nearest)


def look_at(origin: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """The `pose` of a camera at `origin` that looks at `target`; all vectors are [3] (x, y, z).

    Raises ValueError when origin and target coincide or `up` is parallel to the view direction.
    """
    forward = target - origin
    right = torch.linalg.cross(forward, up)
    if not bool(forward.norm() > 0) or not bool(right.norm() > 1e-6 * forward.norm() * up.norm()):
        raise ValueError(
            "origin, target and up do not span a view: "
            "move target away from origin, turn up away from the view direction"
        )
    forward, right = forward / forward.norm(), right / right.norm()
    return torch.stack([right, torch.linalg.cross(right, forward), -forward, origin], dim=1)


def subpixel_offsets(samples: int) -> list[tuple[float, float]]:
    """Places (row, column) of `samples` rays in a pixel, spread evenly over its area.

    No two share a row or a column: where pixels fit cells of a volume, rays of a regular grid would
    all see the same places of cells. They are a lattice of rank 1, with its origin or without, and
    as far apart as may be (Niederreiter 1992, doi:10.1137/1.9781611970081, chapter 5).
    """

    def apart(lattice: tuple[int, int]) -> float:
        size, step = lattice
        rows = torch.arange(1, size)
        sides = torch.stack([rows, rows * step % size])
        squares = (torch.minimum(sides, size - sides) ** 2).sum(0)
        return float(squares.amin()) / size**2 if size > 1 else 0.0

    sizes = samples + 1, samples
    lattices = [(s, n) for s in sizes for n in range(1, s + 1) if math.gcd(n, s) == 1]
    size, step = max(lattices, key=apart)
    rows = torch.arange(size - samples, size)
    places = torch.stack([rows, rows * step % size], 1) - (size - samples)
    return [(row, column) for row, column in ((places.double() + 0.5) / samples).tolist()]


def cast_rays(camera: Camera, *offsets: tuple[float, float]) -> Rays:
    """The rays through every pixel, row by row, R = height * width for each of `offsets`.

    `offsets`: where rays pass through their pixels, in (rows, columns); the middle without any.
    """
    right, up, backward, origin = camera.pose.unbind(1)
    places = torch.cat([image_places(camera, offset) for offset in offsets or [(0.5, 0.5)]])
    if not camera.is_perspective:
        plane = places @ torch.stack([right, -up])
        return Rays(array_order(origin + plane), array_order((-backward).expand_as(plane)), None)
    direction = array_order(_look_through(camera, places))
    eye = array_order(origin)
    return Rays(eye.expand_as(direction), direction, eye)


def _look_through(camera: Camera, places: Tensor) -> Tensor:
    """Unit directions (x, y, z) from a perspective camera through `places` [R, 2]."""
    right, up, backward, _ = camera.pose.unbind(1)
    if camera.lens is None or camera.distortion is None:
        direction = places @ torch.stack([right, -up]) - backward
    else:
        through_lens = ray_through(camera.lens, camera.distortion, places)
        direction = through_lens @ torch.stack([right, -up, -backward])
    return torch.nn.functional.normalize(direction, dim=-1)


def image_places(camera: Camera, offset: tuple[float, float] = (0.5, 0.5)) -> Tensor:
    """Where pixels lie, `[R, 2]` (to the right and down), row by row.

    Places are in the plane one unit in front of a perspective camera, or in the image plane of an
    orthographic one, in world units. `offset` is as for `cast_rays`.
    """
    return _pair(*_place_lines(camera, offset))


def edge_places(camera: Camera) -> Tensor:
    """Those of `image_places` that lie along the edges of the image, in any order."""
    columns, rows = _place_lines(camera, (0.5, 0.5))
    return torch.cat([_pair(columns, rows[[0, -1]]), _pair(columns[[0, -1]], rows)])


def _place_lines(camera: Camera, offset: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """How far to the right columns lie, and how far down rows."""
    (height, width), like, middle = camera.size, camera.pose, camera.principal_point
    row, column = (
        torch.arange(count, dtype=like.dtype, device=like.device) + shift
        for count, shift in zip((height, width), offset, strict=True)
    )
    step = camera.half_width * 2 / width
    down = (row - middle[1] * height) * (step * camera.pixel_aspect)
    return (column - middle[0] * width) * step, down


def _pair(columns: Tensor, rows: Tensor) -> Tensor:
    return torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1).view(-1, 2)


def project(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Where `points` [N, 3] (x, y, z) [u] are seen, `[N, 2]`, and how far away, `[N]`.

    Places are columns and rows from the image's top left corner; NaN behind a perspective camera,
    and beyond the corners of its image, where distortion may have folded over.
    """
    right, up, backward, origin = camera.pose.detach().unbind(1)
    away = points - origin
    ray = torch.stack([away @ right, -(away @ up), -(away @ backward)], 1)
    height, width = camera.size
    if not camera.is_perspective:
        places, is_seen = ray[:, :2], torch.ones_like(ray[:, 2], dtype=torch.bool)
    else:
        places = ray[:, :2] / ray[:, 2:]
        if camera.lens is not None and camera.distortion is not None:
            places = distort(camera.lens, camera.distortion.detach(), ray)
        # The places farthest from the axis are at the image's edges.
        cosine = -(_look_through(camera, edge_places(camera)).detach() @ backward)
        is_seen = ray[:, 2] / away.norm(dim=1) >= cosine.min() - 1e-6
    step = 2 * float(camera.half_width) / width
    x, y = places.unbind(1)
    column = x / step + float(camera.principal_point[0]) * width
    row = y / (step * camera.pixel_aspect) + float(camera.principal_point[1]) * height
    seen = torch.stack([column, row], 1)
    return seen.where(is_seen[:, None], torch.nan), away.norm(dim=1)


def ray_through(model: str, coefficients: Tensor, image: Tensor) -> Tensor:
    """The way of light that meets the places `image` [R, 2]: `[R, 3]` (right, down, forward).

    It is exactly differentiable by `coefficients` and `image`, and of no particular length. Where
    nothing meets a place, because distortion folds over, it is somewhere near.
    """
    if model == "opencv":
        place = _solve(_opencv, coefficients, image)
        return torch.cat([place, torch.ones_like(place[:, :1])], 1)
    distance = image.norm(dim=1, keepdim=True)
    angle = _solve(_fisheye, coefficients, distance)
    return torch.cat([image * _quotient(angle.sin(), distance), angle.cos()], 1)


def distort(model: str, coefficients: Tensor, ray: Tensor) -> Tensor:
    """Where light along `ray` [R, 3] (right, down, forward) meets the image, `[R, 2]`."""
    sideways, forward = ray[:, :2], ray[:, 2:]
    if model == "opencv":
        return _opencv(coefficients, sideways / forward)[0]
    length = sideways.norm(dim=1, keepdim=True)
    moved = _fisheye(coefficients, torch.atan2(length, forward))[0]
    return sideways * _quotient(moved, length)


Distortion = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Places `[R, n]` after distortion by coefficients, and their slopes `[R, n, n]`."""


def _opencv(k: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
    x, y = place.unbind(1)
    square = x**2 + y**2
    k1, k2, k3, k4, p1, p2 = k.unbind()
    radial = 1 + square * (k1 + square * (k2 + square * (k3 + square * k4)))
    rise = 2 * (k1 + square * (2 * k2 + square * (3 * k3 + square * 4 * k4)))
    moved_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x**2)
    moved_y = y * radial + p1 * (square + 2 * y**2) + 2 * p2 * x * y
    across = x * y * rise + 2 * (p1 * x + p2 * y)
    slopes = [
        radial + x**2 * rise + 2 * p1 * y + 6 * p2 * x,
        across,
        across,
        radial + y**2 * rise + 6 * p1 * y + 2 * p2 * x,
    ]
    return torch.stack([moved_x, moved_y], 1), torch.stack(slopes, 1).view(-1, 2, 2)


def _fisheye(k: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
    square = angle**2
    k1, k2, k3, k4 = k.unbind()
    moved = angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
    slope = 1 + square * (3 * k1 + square * (5 * k2 + square * (7 * k3 + square * 9 * k4)))
    return moved, slope[..., None]


def _solve(distortion: Distortion, coefficients: Tensor, target: Tensor) -> Tensor:
    """The places `[R, n]` that `distortion` moves to `target`, by Newton's method from there."""
    with torch.no_grad():
        place, fixed = target.detach().clone(), coefficients.detach()
        enough = 4 * torch.finfo(target.dtype).eps
        for _ in range(MOST_STEPS):
            moved, slopes = distortion(fixed, place)
            step = _divide(moved - target.detach(), slopes)
            place = place - step
            if not bool((step.abs() > enough * (1 + place.abs())).any()):
                break
        slopes = distortion(fixed, place)[1]
    # One more step, with fixed slopes, has the derivative of the implicit function.
    return place - _divide(distortion(coefficients, place)[0] - target, slopes)


def _divide(vector: Tensor, slopes: Tensor) -> Tensor:
    """The `[R, n]` that `slopes` [R, n, n] map to `vector`; 0 where they are singular."""
    if vector.shape[1] == 1:
        determinant, crossed = slopes[:, 0], vector
    else:
        (a, b), (c, d) = (row.split(1, -1) for row in slopes.unbind(1))
        x, y = vector.split(1, 1)
        determinant, crossed = a * d - b * c, torch.cat([d * x - b * y, a * y - c * x], 1)
    return crossed * torch.where(determinant.abs() > 1e-6, 1 / determinant, 0)


def _quotient(value: Tensor, length: Tensor) -> Tensor:
    """`value / length`, and 1 on the axis, where both are 0."""
    is_axis = length == 0
    return torch.where(is_axis, 1, value / torch.where(is_axis, 1, length))
