"""What the rays of a camera meet in a grid, whatever is in it: found once for a camera that stays.

It takes many small operations, and reads of numbers for which a processor waits for a GPU.

View rays are no closer together than a volume can tell: pixels are interpolated between them. Their
lattice is regular in the plane through the box's center, across the axis along which rays cross
most cells, and so it is in every slice.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from ddrecon.cameras import Camera, Rays, cast_rays, subpixel_offsets
from ddrecon.grid import Grid
from ddrecon.march.samplers import Crossing, RaySampling, choose_sampling, cross_box, intersect_box
from ddrecon.numerics.interpolation import ThirdOrder, sample_slices
from ddrecon.numerics.layout import across
from ddrecon.numerics.remember import remember
from ddrecon.settings import RenderSettings

MARGIN = 2
"""Lattice rays beyond the outermost pixels: as far as interpolation reaches."""
FEWER = 2
"""A lattice is worth its interpolation where pixels have so many times as many rays."""
RAYS_PER_VOXEL = 2
"""Lattice rays along the side of a voxel in the middle of the box."""
DOUBT = 1 / 8
"""Error of interpolation as a part of fourth differences: 3/128 in smooth places, up to 3/8 at a
jump.
"""


@dataclass(frozen=True)
class Lattice:
    """`rays` of so many (rows, columns), row by row, and where they run in the box.

    All are in their `crossing`, those that miss the box with no length there. `places` [P, 2] are
    those of pixels' rays in its rows and columns.
    """

    rays: Rays
    crossing: Crossing
    shape: tuple[int, int]
    places: Tensor

    @functools.cached_property
    def cells(self) -> Tensor:
        """Between which four rays places lie [P], counted row by row."""
        rows, columns = self.places.detach().floor().long().unbind(-1)
        return rows * (self.shape[1] - 1) + columns


def choose_lattice(grid: Grid, axis: int, hitting: Rays) -> Lattice | None:
    """The lattice across `axis` in place of rays of one camera, all `hitting` the box.

    None where these are no more work themselves, or the camera is not beyond the slices; and on a
    GPU, which has threads for all of them, and would wait for which pixels are rough.
    """
    if hitting.direction.is_cuda:
        return None
    eye = hitting.eye
    low, high, margin = grid.lower[axis], grid.upper[axis], grid.spacing[axis]
    if eye is not None and low - margin < float(eye[axis].detach()) < high + margin:
        return None
    # Row and column 0 lie half a step within the box.
    distance = (0.5 * (low + high) - hitting.origin[:, axis]) / hitting.direction[:, axis]
    places = []
    for along in across(axis):
        step = grid.spacing[along] / RAYS_PER_VOXEL
        place = hitting.origin[:, along] + distance * hitting.direction[:, along]
        places.append((place - grid.lower[along]) / step - 0.5)
    first = [math.floor(place.detach().amin()) - MARGIN for place in places]
    last = [math.ceil(place.detach().amax()) + MARGIN for place in places]
    rows, columns = (b - a + 1 for a, b in zip(first, last, strict=True))
    if FEWER * rows * columns > len(hitting.direction):
        return None
    rays = _lattice_rays(grid, axis, hitting, first, (rows, columns))
    near, far = intersect_box(grid, rays)
    # Where a ray that misses enters may be infinitely far.
    near, far = (torch.where(far > near, distance, 0) for distance in (near, far))
    crossing = Crossing(torch.arange(len(near), device=near.device), near, far)
    within = torch.stack([place - a for place, a in zip(places, first, strict=True)], -1)
    return Lattice(rays, crossing, (rows, columns), within)


def _lattice_rays(
    grid: Grid, axis: int, like: Rays, first: Sequence[int], shape: tuple[int, int]
) -> Rays:
    """Rays of a lattice of this `shape`, through one point or parallel as those `like` them."""
    point = [like.direction.new_tensor(0.5 * (grid.lower[axis] + grid.upper[axis]))] * 3
    lines = []
    for along, a, count in zip(across(axis), first, shape, strict=True):
        step = grid.spacing[along] / RAYS_PER_VOXEL
        index = torch.arange(a, a + count, dtype=like.direction.dtype).to(like.direction.device)
        lines.append(grid.lower[along] + 0.5 * step + step * index)
    for along, place in zip(across(axis), torch.meshgrid(*lines, indexing="ij"), strict=True):
        point[along] = place.flatten()
    points = torch.stack(torch.broadcast_tensors(*point), -1)
    if like.eye is None:
        # They begin outside of the box.
        way = like.direction[0]
        far = 2 * math.hypot(*grid.extent) / (way[axis].abs() if grid.periodic else 1)
        return Rays(points - far * way, way.expand_as(points), None)
    return Rays(like.eye.expand_as(points), normalize(points - like.eye, dim=-1), like.eye)


def interpolate(values: Tensor, places: Tensor) -> Tensor:
    """`values` [K, r, c] of lattice rays at `places` [P, 2] in it, to third order: [K, P]."""
    sizes = places.new_tensor(values.shape[1:])
    points = ((2 * places + 1) / sizes - 1).flip(-1)
    return sample_slices(values[None], points[None], ThirdOrder(0, values.shape[0]))[0]


def find_rough(values: Tensor, lattice: Lattice, tolerance: float, behind: Tensor | None) -> Tensor:
    """Which pixels interpolation may change too much: numbers [*].

    By more than `tolerance` of the image's root mean square, where `values` [K, r, c] are those of
    the lattice's rays: radiance, and if something is `behind`, opacity. Their errors count together
    and are judged by fourth differences, which are large at edges sharper than the lattice as well.
    Pixels come in an order in which neighbors are neighbors in the volume: along stripes as high as
    a voxel.
    """
    values = radiance = values.detach()
    if behind is not None:
        (scattered, opacity), brightest = values.chunk(2), behind.detach().max()
        radiance = scattered + brightest * (1 - opacity)
        values = torch.cat([scattered, brightest * opacity])
    size = float(radiance.square().mean(dtype=torch.float64).sqrt())
    # In numpy: the arrays are small. Between the outermost two rays lie no pixels.
    v = values.cpu().numpy()
    down, along = np.diff(v, 4, axis=1)[:, :, 2:-2], np.diff(v, 4, axis=2)[:, 2:-2]
    uneven = np.pad((np.abs(down) + np.abs(along)).sum(0), 2)
    # Of each place, the largest of the four rays around.
    rows = np.maximum(uneven[1:], uneven[:-1])
    is_rough = DOUBT * np.maximum(rows[:, 1:], rows[:, :-1]) > tolerance * size
    numbers = is_rough.ravel()[lattice.cells.cpu().numpy()].nonzero()[0]
    rough = torch.from_numpy(numbers).to(values.device)
    rows, columns = lattice.places.detach()[rough].unbind(-1)
    stripe = (rows / RAYS_PER_VOXEL).floor()
    return rough[(stripe * lattice.shape[1] + columns).argsort(stable=True)]


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
