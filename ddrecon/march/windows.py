"""What a camera sees through the faces of a box that refract light (docs/theory.md E2.14)."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ddrecon.cameras import Camera, Pane, Rays, cast_rays, subpixel_offsets
from ddrecon.errors import UsageError
from ddrecon.grid import Grid
from ddrecon.light.moments import fill
from ddrecon.march.integral import march
from ddrecon.march.outgoing import OutgoingLight
from ddrecon.march.samplers import cross_box
from ddrecon.march.sight import Sight, look_along
from ddrecon.medium.coefficients import Medium
from ddrecon.medium.optics import reflectance, refract
from ddrecon.numerics.interpolation import sample_volume
from ddrecon.numerics.remember import remember
from ddrecon.numerics.sphere import harmonics
from ddrecon.settings import RenderSettings


@dataclass(frozen=True)
class Window:
    """What the rays of a camera at `numbers` [R] see through one face of the box.

    `sight` is theirs inside, of whose radiance the part `passed` [R] is seen. Where they come to
    another face, at `points` [R, 3], it is made of light from `outside` [R, 3] that goes through,
    and of light from `inside` [R, 3] that is `reflected` [R]; both point against the light.
    """

    numbers: Tensor
    sight: Sight
    passed: Tensor
    points: Tensor
    outside: Tensor
    inside: Tensor
    reflected: Tensor


@remember
def look_inside(
    camera: Camera, grid: Grid, index: float, settings: RenderSettings
) -> tuple[Rays, tuple[Window, ...]]:
    """All rays of `camera`, as `look_through` has them, and its windows; both are kept."""
    rays = cast_rays(camera, *subpixel_offsets(settings.samples_per_pixel))
    return rays, _open(rays, grid, index, replace(settings, tolerance=0.0))


def _open(rays: Rays, grid: Grid, index: float, settings: RenderSettings) -> tuple[Window, ...]:
    """The windows of one camera's `rays`, which begin outside the box."""
    crossing = cross_box(grid, rays)
    if not bool((crossing.near > 0).all()):
        raise UsageError("volume.index: there is none with a camera inside the box")
    hitting, windows = rays.select(crossing.hit), list[Window]()
    entry = hitting.origin + crossing.near[:, None] * hitting.direction
    low, high = (entry.new_tensor(corner) for corner in (grid.lower, grid.upper))
    # The face that is met last of those that look towards the eye.
    nearer = torch.where(hitting.direction > 0, low, high)
    met = (nearer - hitting.origin) / hitting.direction
    axis_met = torch.where(hitting.direction == 0, -torch.inf, met).argmax(1)
    axes = torch.eye(3, dtype=entry.dtype, device=entry.device)
    for axis in range(3):
        for sign in (1, -1):
            is_inward = hitting.direction[:, axis].sign() == sign
            entering = ((axis_met == axis) & is_inward).nonzero()[:, 0]
            if not len(entering):
                continue
            numbers, points = crossing.hit[entering], entry[entering]
            direction = refract(hitting.direction[entering], axes[axis], 1 / index)
            passed = (1 - reflectance(direction[:, axis].abs(), index)) / index**2
            face = (grid.lower if sign > 0 else grid.upper)[axis]
            pane = None if rays.eye is None else Pane(axis, face, index)
            # They begin outside of the box, from where slices can be counted.
            begin = points - max(grid.extent) * direction
            sight = look_along(grid, Rays(begin, direction, rays.eye, pane), settings)
            ahead = (torch.where(direction > 0, high, low) - points) / direction
            distance, far = torch.where(direction == 0, torch.inf, ahead).min(1)
            normal = axes[far]
            cosine = (direction * normal).sum(1).abs()
            windows.append(
                Window(
                    numbers,
                    sight,
                    passed,
                    points + distance[:, None] * direction,
                    refract(direction, normal, index),
                    direction * (1 - 2 * normal),
                    reflectance(cosine, index),
                )
            )
    return tuple(windows)


def see_through(
    window: Window,
    outgoing: OutgoingLight,
    light: Tensor,
    medium: Medium,
    background: Tensor | None,
    settings: RenderSettings,
) -> Tensor:
    """The radiance [C, R] that a camera sees of `medium` through `window`.

    `background` [C, R] is the radiance outside, where rays leave the box, None for black; `light`
    is phi of what the far face reflects.
    """
    grid, degree = medium.grid, medium.degree
    places = [
        (2 * window.points[:, a] - grid.lower[a] - grid.upper[a]) / grid.extent[a]
        for a in (2, 1, 0)
    ]
    moments = fill(light, degree)
    phi = sample_volume(moments.flatten(0, 1), torch.stack(places, -1)[None])[:, 0]
    along = harmonics(-window.inside, degree)[:, None] * phi.unflatten(0, moments.shape[:2])
    behind = window.reflected * along.sum(0).clamp(min=0)
    if background is not None:
        behind = behind + (1 - window.reflected) * medium.index**2 * background
    return window.passed * march(outgoing, window.sight, settings, behind)
