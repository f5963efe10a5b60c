"""Which way of sampling a bundle of view rays allows."""

from __future__ import annotations

from dataclasses import dataclass

from torch.nn.functional import normalize

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.march.bands import Bands
from ddrecon.march.box import Crossing
from ddrecon.march.emission import Channels
from ddrecon.march.equidistant import Equidistant

STEEPEST = 0.2
"""Smallest direction cosine, in units of cells and against the axis across the slices, of rays that
are marched by slices.
"""


@dataclass(frozen=True)
class Way:
    """How rays are sampled: in slices across `axis`, the last one first where it `is_reversed`.

    Where `axis` is None it is at equal steps, and the longest ray is `longest` [u] in the box.
    """

    axis: int | None
    is_reversed: bool = False
    longest: float = 0.0


def choose_way(grid: Grid, rays: Rays, crossing: Crossing) -> Way:
    """Slices where every ray crosses them in one sense and steeply enough, from outside the box."""
    speed = normalize(rays.direction[crossing.hit] / rays.direction.new_tensor(grid.spacing), dim=1)
    axis = int(speed.abs().mean(0).argmax())
    along = speed[:, axis]
    is_steep = bool((along > STEEPEST).all()) or bool((along < -STEEPEST).all())
    if is_steep and bool((crossing.near > 0).all()):
        return Way(axis, bool(along[0] < 0))
    return Way(None, longest=float((crossing.far - crossing.near).detach().max()))


def make_sampler(channels: Channels, grid: Grid, way: Way, steps: int) -> Bands | Equidistant:
    """Slices of `channels`, in bands, or equal steps through them, `steps` to a cell."""
    if way.axis is None:
        return Equidistant(channels, grid, way.longest, steps)
    return Bands(channels, grid, way.axis, way.is_reversed, steps)
