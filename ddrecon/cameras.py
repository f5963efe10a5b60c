"""Cameras: which world ray belongs to which pixel.

Row 0 of an image is its top; +x of the image is to the right of someone looking from origin to
target with `up` up. World vectors here are (x, y, z); `cast_rays` hands them on in array order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ddrecon.grid import Triple, array_order


@dataclass(eq=False)
class Camera:
    """A camera: `pose` is the camera-to-world matrix `[3, 4]` with OpenGL axes (right, up,
    backward, origin), rigid.

    `size`: (height, width) in pixels. `is_perspective` chooses between perspective, whose
    horizontal field of view is `2 atan(half_width)`, and orthographic, whose image is `2
    half_width` world units wide. The axis meets the image at `principal_point`, as parts of its
    width and height from the top left; `pixel_aspect` is the height of a pixel over its width.
    """

    pose: Tensor
    size: tuple[int, int]
    half_width: float
    is_perspective: bool = True
    principal_point: tuple[float, float] = (0.5, 0.5)
    pixel_aspect: float = 1.0

    def resize(self, factor: int) -> Camera:
        """The same camera, seeing the same, with `factor` times fewer pixels along each side (at
        least one).
        """
        height, width = (max(1, side // factor) for side in self.size)
        aspect = self.pixel_aspect * (self.size[0] * width) / (self.size[1] * height)
        return replace(self, size=(height, width), pixel_aspect=aspect)


def twist(camera: Camera, twist: Tensor, pivot: Triple) -> Camera:
    """`camera` moved by `twist` [6]: turned about `pivot` (x, y, z) by a rotation vector [rad],
    then shifted [u].

    Both vectors are in the camera's own axes (right, up, backward). With the pivot amid what the
    camera looks at, a turn shows another side of it and a shift moves it in the image, so that the
    two are told apart by what they do.
    """
    turn, origin = camera.pose[:, :3], camera.pose[:, 3]
    center = origin.new_tensor(pivot)
    rotation = turn @ _rotation(twist[:3]) @ turn.T
    moved = center + rotation @ (origin - center) + turn @ twist[3:]
    return replace(camera, pose=torch.cat([rotation @ turn, moved[:, None]], 1))


def _rotation(vector: Tensor) -> Tensor:
    """The matrix [3, 3] of the rotation by |vector| [rad] about `vector`, by Rodrigues' formula.

    Near zero by series: the formula is smooth there, but not term by term.
    """
    square = vector @ vector
    is_small = square < 1e-3
    angle = torch.where(is_small, 1, square).sqrt()
    sine = torch.where(
        is_small, 1 - square / 6 * (1 - square / 20 * (1 - square / 42)), angle.sin() / angle
    )
    rest = torch.where(
        is_small,
        0.5 - square / 24 * (1 - square / 30 * (1 - square / 56)),
        (1 - angle.cos()) / angle**2,
    )
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    return (
        torch.eye(3, dtype=vector.dtype, device=vector.device) + sine * cross + rest * cross @ cross
    )


@dataclass(frozen=True)
class Rays:
    """View rays in array order: `origin` [R, 3] in u and `direction` [R, 3] of unit length, away
    from the camera.

    `eye` [3] is the point all rays of a perspective camera pass through, None for parallel rays.
    """

    origin: Tensor
    direction: Tensor
    eye: Tensor | None

    def select(self, index: Tensor) -> Rays:
        """The rays at `index`."""
        return Rays(self.origin[index], self.direction[index], self.eye)

    @staticmethod
    def join(bundles: Sequence[Rays]) -> Rays:
        """All rays of some `bundles` of one camera, bundle by bundle."""
        return Rays(
            torch.cat([b.origin for b in bundles]),
            torch.cat([b.direction for b in bundles]),
            bundles[0].eye,
        )


def look_at(origin: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """Camera-to-world matrix `[3, 4]` of a camera at `origin` looking at `target`; all three are
    `[3]` (x, y, z).

    Raises ValueError when origin and target coincide or `up` is parallel to the view direction.
    """
    forward = target - origin
    right = torch.linalg.cross(forward, up)
    if not bool(forward.norm() > 0) or not bool(right.norm() > 1e-6 * forward.norm() * up.norm()):
        raise ValueError(
            "origin, target and up do not span a view: move target away from origin, turn up away from the view direction"
        )
    forward, right = forward / forward.norm(), right / right.norm()
    return torch.stack([right, torch.linalg.cross(right, forward), -forward, origin], dim=1)


def subpixel_offsets(samples: int) -> list[tuple[float, float]]:
    """Centers (row, column), in pixels, of `samples` equal parts of a pixel laid out as squarely as
    `samples` divides.
    """
    rows = max(n for n in range(1, math.isqrt(samples) + 1) if samples % n == 0)
    columns = samples // rows
    return [((i + 0.5) / rows, (j + 0.5) / columns) for i in range(rows) for j in range(columns)]


def cast_rays(camera: Camera, offset: tuple[float, float] = (0.5, 0.5)) -> Rays:
    """The rays through every pixel, row by row, at `offset` (row, column) within the pixel: R =
    height * width.
    """
    height, width = camera.size
    pose = camera.pose
    middle = camera.principal_point
    row = (
        torch.arange(height, dtype=pose.dtype, device=pose.device) + offset[0] - middle[1] * height
    ) * (-2 * camera.pixel_aspect / width)
    column = (
        torch.arange(width, dtype=pose.dtype, device=pose.device) + offset[1] - middle[0] * width
    ) * (2 / width)
    y, x = torch.meshgrid(row * camera.half_width, column * camera.half_width, indexing="ij")
    right, up, backward, origin = pose.unbind(1)
    plane = x.reshape(-1, 1) * right + y.reshape(-1, 1) * up
    if camera.is_perspective:
        direction = torch.nn.functional.normalize(plane - backward, dim=-1)
        return Rays(
            array_order(origin.expand_as(direction)), array_order(direction), array_order(origin)
        )
    return Rays(array_order(origin + plane), array_order((-backward).expand_as(plane)), None)
