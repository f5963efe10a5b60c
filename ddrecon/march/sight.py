"""What the rays of a camera meet in a grid, whatever is in it: found once for a camera that stays.

It takes many small operations, and reads of numbers for which a processor waits for a GPU.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass, fields
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from ddrecon.cameras import Camera, Rays, cast_rays, subpixel_offsets
from ddrecon.grid import Grid
from ddrecon.march.box import Crossing, cross_box
from ddrecon.march.lattice import Lattice, choose_lattice
from ddrecon.march.samplers import Way, choose_way
from ddrecon.numerics.autodiff import is_forward, version_of
from ddrecon.settings import RenderSettings

LIMIT = 1 << 28
"""Bytes of what is kept for all cameras; for others it is found again each time."""


@dataclass(frozen=True)
class Sight:
    """The `rays` of one camera, their `crossing` of the box, and the `way` they are sampled.

    `way` is None where no ray meets the box. `places` [P, 2] are those of the rays that do in the
    rows and columns of `lattice`; both are None where every pixel has a ray of its own.
    """

    rays: Rays
    crossing: Crossing
    way: Way | None
    lattice: Lattice | None = None
    places: Tensor | None = None

    @property
    def is_whole(self) -> bool:
        """Whether every ray meets the box; `crossing` then has them in their order."""
        return len(self.crossing.hit) == len(self.rays.direction)

    @property
    def bytes(self) -> int:
        """What its tensors take."""
        rays, crossing = self.rays, self.crossing
        tensors = [rays.direction, crossing.hit, crossing.near, crossing.far, self.places]
        if rays.eye is None:
            tensors.append(rays.origin)
        return sum(tensor.nbytes for tensor in tensors if tensor is not None)


def look_along(grid: Grid, rays: Rays, settings: RenderSettings) -> Sight:
    """The sight of `rays` of one camera."""
    crossing = cross_box(grid, rays)
    if crossing.hit.numel() == 0:
        return Sight(rays, crossing, None)
    way = choose_way(grid, rays, crossing)
    if settings.tolerance > 0 and way.axis is not None:
        hitting = rays.select(crossing.hit)
        lattice = choose_lattice(grid, way.axis, hitting)
        if lattice is not None:
            return Sight(rays, crossing, way, lattice, lattice.places(hitting))
    return Sight(rays, crossing, way)


def look_through(camera: Camera, grid: Grid, settings: RenderSettings) -> Sight:
    """The sight of all rays of `camera`, bundle by bundle of its subpixels.

    It is kept with the camera, unless that is varied, and found anew when any of its fields is
    another or has changed.
    """
    tensors = camera.tensors
    is_varied = any(tensor.requires_grad or tensor.is_inference() for tensor in tensors)
    if is_varied or is_forward():
        return _look(camera, grid, settings)
    key = _key(camera, grid, settings)
    kept = _KEPT.get(camera)
    if kept is None or kept[0] != key or not all(map(operator.is_, kept[1], tensors)):
        _KEPT.pop(camera, None)
        with torch.inference_mode(False), torch.no_grad():
            kept = key, tensors, _look(camera, grid, settings)
        if kept[2].bytes + sum(sight.bytes for _, _, sight in _KEPT.values()) <= LIMIT:
            _KEPT[camera] = kept
    return kept[2]


_KEPT: WeakKeyDictionary[Camera, tuple[tuple[Any, ...], list[Tensor], Sight]] = WeakKeyDictionary()
"""By camera, as long as it is there: what its sight was found for, its tensors and its sight."""


def _key(camera: Camera, grid: Grid, settings: RenderSettings) -> tuple[Any, ...]:
    values = (getattr(camera, part.name) for part in fields(camera))
    plain = (value for value in values if not isinstance(value, Tensor))
    versions = tuple(map(version_of, camera.tensors))
    # The numbers themselves where an array of NumPy has the same memory: nobody counts its changes.
    numbers = tuple(
        tensor.detach().numpy().tobytes()
        for tensor in camera.tensors
        if not tensor.untyped_storage().resizable()
    )
    is_interpolated = settings.tolerance > 0
    return (versions, numbers, *plain, grid, settings.samples_per_pixel, is_interpolated)


def _look(camera: Camera, grid: Grid, settings: RenderSettings) -> Sight:
    offsets = subpixel_offsets(settings.samples_per_pixel)
    return look_along(grid, Rays.join([cast_rays(camera, offset) for offset in offsets]), settings)
