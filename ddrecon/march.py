"""View rays: the integral of what the medium sends towards the camera (docs/theory.md E1-E3).

Rays are marched slice by slice along the axis along which they cross most cells, with two-dimensional interpolation in each slice; where
that is not possible (a camera inside the box, rays nearly along a slice) by three-dimensional interpolation at equal steps.
Between two nodes of a ray density and optical depth are taken as linear, so emission times transmittance has a closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeGuard

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ddrecon.autodiff import recomputed
from ddrecon.cameras import Rays
from ddrecon.decay import decayed_sum
from ddrecon.grid import Grid
from ddrecon.medium import Coefficient
from ddrecon.nodes import Nodes
from ddrecon.point_light import PointBeam
from ddrecon.reduced import Beam
from ddrecon.sampling import Smooth, sample_slices, sample_volume, subdivided

CHUNK_NODES = 1 << 18
"""Nodes marched at a time: few enough that a chunk's tensors stay in a processor's cache, and memory does not grow with pixels."""
CELLS_PER_NODE = 16
"""In large volumes a chunk has a node for so many cells: its backward pass fills an array of all cells, whatever the number of nodes."""
STEEPEST = 0.2
"""Smallest direction cosine, in units of cells and against the axis across the slices, of rays that are marched by slices."""


@dataclass(frozen=True)
class Emission:
    """What a volume sends towards one camera: its `extinction`, `scattering`, light `beams`, and `diffuse` [C, z, y, x].

    `diffuse` is the radiance that scatters into the camera's rays from all other light, so that emission per unit length is
    kappa_s (diffuse + sum over beams of p E tau / (4 pi)); `g` is the mean cosine of p. Point lights have E = I / r^2. `peak` is the
    medium's: what its forward peak does to p.
    """

    grid: Grid
    extinction: Coefficient
    scattering: Coefficient
    beams: tuple[Beam | PointBeam, ...]
    diffuse: Tensor
    g: Tensor
    peak: Tensor | None

    @property
    def colors(self) -> int:
        """How many colors leave: 3 as soon as medium or any light has 3."""
        return max(self.diffuse.shape[0], self.extinction.scale.shape[0], *(beam.irradiance.shape[0] for beam in self.beams), 1)


@dataclass(frozen=True)
class Crossing:
    """The part of each ray inside the box: where rays `hit` it (indices), and distances [u] to `near` and `far` there."""

    hit: Tensor
    near: Tensor
    far: Tensor


def march(emission: Emission, rays: Rays, steps_per_voxel: int) -> tuple[Tensor, Tensor]:
    """Radiance [C, R] scattered towards the camera along `rays`, and transmittance [C, R] of the whole volume along them."""
    crossing = cross_box(emission.grid, rays)
    blank = emission.diffuse.new_zeros(emission.colors, rays.direction.shape[0])
    if crossing.hit.numel() == 0:
        return blank, blank + 1
    sampler = _sampler(emission, rays, crossing, steps_per_voxel)

    def run(chunk: Tensor) -> tuple[Tensor, Tensor]:
        chosen = crossing.hit[chunk]
        origin, direction = rays.origin[chosen], rays.direction[chosen]
        values, distance = sampler.sample(origin, direction, crossing.near[chunk], crossing.far[chunk])
        return _integrate(emission, values, Nodes(origin, direction, distance))

    nodes = max(CHUNK_NODES, emission.grid.cells // CELLS_PER_NODE)
    chunks = torch.arange(crossing.hit.numel(), device=blank.device).split(max(1, nodes // sampler.nodes))
    parts = [recomputed(run, chunk) for chunk in chunks]
    scattered, transmittance = (torch.cat(part, 1) for part in zip(*parts, strict=True))
    return blank.index_copy(1, crossing.hit, scattered), (blank + 1).index_copy(1, crossing.hit, transmittance)


def cross_box(grid: Grid, rays: Rays) -> Crossing:
    """Where `rays` run inside the box of `grid`, in front of the camera."""
    low, high = (rays.direction.new_tensor(corner) for corner in (grid.lower, grid.upper))
    tiny = torch.finfo(rays.direction.dtype).tiny
    safe = torch.where(rays.direction.abs() < tiny, torch.full_like(rays.direction, tiny), rays.direction)
    one, other = (low - rays.origin) / safe, (high - rays.origin) / safe
    near = torch.minimum(one, other).amax(-1).clamp(min=0)
    far = torch.maximum(one, other).amin(-1)
    hit = (far > near).nonzero()[:, 0]
    return Crossing(hit, near[hit], far[hit])


class _Slices:
    """Values where rays cross the planes through the cell centers across `axis`, and the two faces of the box."""

    def __init__(self, fields: Tensor, smooth: Smooth | None, grid: Grid, axis: int, is_reversed: bool, steps: int):
        self.smooth = smooth
        self.axis, self.across = axis, [other for other in range(3) if other != axis]
        self.lower, self.extent = grid.lower, grid.extent
        count = grid.shape[axis]
        place = torch.arange(count + 2, dtype=fields.dtype, device=fields.device) - 0.5
        planes = grid.lower[axis] + place.clamp(0, count) * grid.spacing[axis]
        index = (place - 0.5).clamp(0, count - 1).long()
        if is_reversed:
            index, planes = index.flip(0), planes.flip(0)
        slices = fields.permute(1 + axis, 0, *(1 + other for other in self.across)).index_select(0, index)
        self.slices, self.planes = subdivided(slices, steps, smooth), subdivided(planes, steps)
        self.nodes = len(self.planes)

    def sample(self, origin: Tensor, direction: Tensor, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        distance = (self.planes[:, None] - origin[:, self.axis]) / direction[:, self.axis]
        points = [2 * (origin[:, a] + distance * direction[:, a] - self.lower[a]) / self.extent[a] - 1 for a in self.across]
        values = sample_slices(self.slices, torch.stack([points[1], points[0]], -1), smooth=self.smooth)
        return values, torch.minimum(torch.maximum(distance, near), far)


class _Equidistant:
    """Values at equal steps along rays, wherever these run."""

    def __init__(self, fields: Tensor, smooth: Smooth | None, grid: Grid, longest: float, steps: int):
        self.smooth = smooth
        self.fields, self.lower, self.extent = fields, fields.new_tensor(grid.lower), fields.new_tensor(grid.extent)
        self.nodes = steps * math.ceil(longest / min(grid.spacing)) + 1

    def sample(self, origin: Tensor, direction: Tensor, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
        part = torch.linspace(0, 1, self.nodes, dtype=near.dtype, device=near.device)[:, None]
        distance = near + part * (far - near)
        points = 2 * (origin + distance[..., None] * direction - self.lower) / self.extent - 1
        values = sample_volume(self.fields, points.flip(-1), self.smooth)
        return values.transpose(0, 1), distance


def _sampler(emission: Emission, rays: Rays, crossing: Crossing, steps: int) -> _Slices | _Equidistant:
    """Slices where every ray crosses them in one sense and steeply enough, from outside the box; else equal steps."""
    fields = torch.cat(_fields(emission))
    first = emission.extinction.field.shape[0] + emission.diffuse.shape[0]
    last = first + sum(beam.mass.shape[0] for beam in emission.beams)
    smooth = Smooth(first, last, emission.extinction.mass_bound) if emission.beams else None
    speed = normalize(rays.direction[crossing.hit] / rays.direction.new_tensor(emission.grid.spacing), dim=1)
    axis = int(speed.abs().mean(0).argmax())
    along = speed[:, axis]
    is_steep = bool((along > STEEPEST).all()) or bool((along < -STEEPEST).all())
    if is_steep and bool((crossing.near > 0).all()):
        return _Slices(fields, smooth, emission.grid, axis, bool(along[0] < 0), steps)
    return _Equidistant(fields, smooth, emission.grid, float((crossing.far - crossing.near).max()), steps)


def _fields(emission: Emission) -> list[Tensor]:
    """The fields to interpolate, each `[channels, z, y, x]`; scattering only where it is not the extinction's field again."""
    fields = [emission.extinction.field, emission.diffuse, *(beam.mass for beam in emission.beams)]
    if emission.scattering.field is not emission.extinction.field:
        fields.append(emission.scattering.field)
    if _is_field(emission.peak):
        fields.append(emission.peak)
    return fields


def _is_field(peak: Tensor | None) -> TypeGuard[Tensor]:
    """Whether the medium's `peak` differs from cell to cell."""
    return peak is not None and peak.shape[1:].numel() > 1


def _integrate(emission: Emission, values: Tensor, nodes: Nodes) -> tuple[Tensor, Tensor]:
    """Scattered radiance and transmittance, each [C, R], from `values` [N, channels, R] at the `nodes`."""
    sizes = [field.shape[0] for field in _fields(emission)]
    extinction, diffuse, *others = values.split(sizes, 1)
    peak = others.pop() if _is_field(emission.peak) else emission.peak.view(-1, 1) if emission.peak is not None else None
    masses, scattering = others[: len(emission.beams)], (others[len(emission.beams) :] or [extinction])[0]
    scale = emission.extinction.scale.view(-1, 1).expand(emission.colors, 1)
    mass = nodes.integral(extinction)
    end = mass.cumsum(0)
    begin = end - mass
    scattered = decayed_sum(nodes.integral(scattering * diffuse), begin, end, scale)
    passed = torch.cat([torch.zeros_like(end[:1]), end])
    for beam, beam_mass in zip(emission.beams, masses, strict=True):
        weight, phase = beam.scattered(scattering, nodes, emission.g, None if peak is None else peak * (passed + beam_mass))
        arriving = decayed_sum(weight, begin + beam_mass[:-1], end + beam_mass[1:], scale)
        scattered = scattered + arriving * phase * (beam.irradiance.view(-1, 1) / (4 * math.pi))
    return scattered * emission.scattering.scale.view(-1, 1), torch.exp(-scale * end[-1])
