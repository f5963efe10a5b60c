"""Lens distortion: where light from a direction meets the image, and the way back.

Directions are places (x right, y down) on the plane one unit in front of the camera, as OpenCV has
them, and so are places in the image, once the principal point is taken off and the focal length
divided out. Both models are written as OpenCV, COLMAP and nerfstudio write them:

- `opencv` moves a place u at distance r from the axis to
  u (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8), plus
  (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y)
  (Brown 1966; k4 as in nerfstudio);
- `fisheye` moves a direction at angle t from the axis to the distance
  t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) from it (Kannala and Brandt 2006,
  doi:10.1109/TPAMI.2006.153).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

MOST_STEPS = 50
"""Newton steps at most; three or four are enough for any lens that is sold."""


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
