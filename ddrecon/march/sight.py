"""What the rays of a camera meet in a grid, whatever is in it: found once for a camera that stays.

It takes many small operations, and reads of numbers for which a processor waits for a GPU.
"""

from __future__ import annotations

from dataclasses import dataclass

from ddrecon.cameras import Camera, Rays, cast_rays, subpixel_offsets
from ddrecon.grid import Grid
from ddrecon.march.box import Crossing, cross_box
from ddrecon.march.lattice import Lattice, choose_lattice
from ddrecon.march.samplers import RaySampling, choose_sampling
from ddrecon.numerics.remember import remember
from ddrecon.settings import RenderSettings


@dataclass(frozen=True)
class Sight:
    """The `rays` of one camera, their `crossing` of the box, and their `sampling`.

    `sampling` is None where no ray meets the box, `lattice` where every pixel has a ray of its own.
    """

    rays: Rays
    crossing: Crossing
    sampling: RaySampling | None
    lattice: Lattice | None = None


def look_along(grid: Grid, rays: Rays, settings: RenderSettings) -> Sight:
    """The sight of `rays` of one camera."""
    crossing = cross_box(grid, rays)
    if crossing.hit.numel() == 0:
        return Sight(rays, crossing, None)
    sampling = choose_sampling(grid, rays, crossing)
    if settings.tolerance == 0 or sampling.axis is None or sampling.axis in grid.periodic:
        return Sight(rays, crossing, sampling)
    return Sight(
        rays, crossing, sampling, choose_lattice(grid, sampling.axis, rays.select(crossing.hit))
    )


@remember
def look_through(camera: Camera, grid: Grid, settings: RenderSettings) -> Sight:
    """The sight of all rays of `camera`, bundle by bundle of its subpixels; it is kept."""
    rays = cast_rays(camera, *subpixel_offsets(settings.samples_per_pixel))
    return look_along(grid, rays, settings)
