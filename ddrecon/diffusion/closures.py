"""Closures: what D becomes where the medium thins out and 1 / (3 kappa_tr) grows without bound.

A closure turns the transport extinction [C, z, y, x] into the diffusion coefficient D [u] of the
same shape, finite and with finite derivatives at zero density. `CLOSURES` is the table the scene
file chooses from.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from ddrecon.diffusion.operator import AXES
from ddrecon.grid import Grid
from ddrecon.medium.coefficients import Coefficient
from ddrecon.numerics.interpolation import resize

BACKGROUND = 0.01
"""Optical thickness, across a side of the box, of a haze that gives an empty box distances too.

Accuracy is flat from 0.001 to 0.1.
"""
COARSE_CELLS = 32
"""Distances, which are smooth, are computed on at most so many cells along the longest side.

16, 32 and 64 render alike.
"""
GAP, NOTHING = 1.0, 1e-3
"""In a medium that repeats light spreads in gaps of `GAP` times its thickness, of which empty
layers are so small a part: beyond the medium nothing holds it up.
"""
FLOOR = 3.3
"""Optical thickness of empty space across the box's shortest side, by the closure `smooth`."""


def smooth(transport_extinction: Tensor, grid: Grid) -> Tensor:
    """D = 1 / (3 sqrt(kappa_tr^2 + (FLOOR / shortest side of the box)^2))."""
    least = FLOOR / min(grid.extent)
    return 1 / (3 * torch.sqrt(transport_extinction**2 + least**2))


def geometric(transport_extinction: Tensor, grid: Grid) -> Tensor:
    """D = 1 / (3 kappa_tr + 4 / distance): collisions and spreading, two resistances in series.

    See docs/theory.md, section 5. `distance` is that to the medium. Below zero, where only finite
    differences go, D is continued to second order and stays positive.
    """
    # D = 1 / (spreading (1 + ratio)), with spreading = 4 / distance
    unit = transport_extinction.new_ones(())
    spreading = 4 * inverse_distance([Coefficient(unit, transport_extinction)], grid)
    ratio = 3 * transport_extinction / spreading
    inverse = torch.where(ratio < 0, 1 - ratio + ratio**2, 1 / (1 + ratio.clamp(min=0)))
    return inverse / spreading


def inverse_distance(weight: Sequence[Coefficient], grid: Grid) -> Tensor:
    """The mean of 1 / distance [1/u] from each cell to all `weight`, `[C, z, y, x]`.

    The weight is a sum of coefficients >= 0: a field that colors share is transformed once for all.
    It is computed on a coarse grid and interpolated. Outside a sphere this is
    1 / (distance to its center), exactly: Newton's shell theorem. Where the box repeats without end
    all matter is infinitely far in the mean: the distance is that of gaps, as thick as the box or,
    along two axes, as all layers that have any medium.
    """
    if grid.periodic:
        sides = (side for axis, side in enumerate(grid.extent) if axis not in grid.periodic)
        if len(grid.periodic) == 2:
            return _inverse_thickness(weight, grid)
        return weight[0].field.new_full((1, *grid.shape), 1 / (GAP * min(sides)))
    coarse = grid.coarsen(math.ceil(max(grid.shape) / COARSE_CELLS))
    # The haze, kappa_tr [1/u] that cells have besides their own.
    even = 3 * BACKGROUND / sum(grid.extent)
    masses = [(term.scale, resize(term.field, coarse.shape, "area")) for term in weight]
    like = masses[0][1]
    potentials = even * _even_potential(coarse, like.dtype, like.device)
    total: float | Tensor = even * coarse.cells
    for scale, mass in masses:
        potentials = potentials + scale * potential(mass, coarse)
        total = total + scale * mass.sum((1, 2, 3), keepdim=True)
    return resize(potentials / total, grid.shape, "linear")


def _inverse_thickness(weight: Sequence[Coefficient], grid: Grid) -> Tensor:
    """1 over the thickness of all layers that have `weight` [1/u], and next to 0 where none has."""
    (axis,) = {0, 1, 2} - {*grid.periodic}
    around = [dim for dim in AXES if dim != axis + 1]
    haze = BACKGROUND / grid.extent[axis]
    layers = reduce(
        torch.add, (term.scale * term.field.mean(around, keepdim=True) for term in weight)
    )
    filled = (layers + NOTHING * haze) / (layers + haze)
    thickness = GAP * grid.spacing[axis] * filled.sum((1, 2, 3), keepdim=True)
    return (filled / thickness).expand(-1, *grid.shape).contiguous()


def potential(mass: Tensor, grid: Grid) -> Tensor:
    """The sum over cells of `mass` / distance [1/u], by Fourier transform.

    The box is twice as wide, so that periods do not overlap; colors come one at a time, for memory.
    """
    wide = [2 * cells for cells in grid.shape]
    spectrum = _spectrum(grid, mass.dtype, mass.device)
    summed = [torch.fft.irfftn(torch.fft.rfftn(color, wide) * spectrum, wide) for color in mass]
    depth, height, width = grid.shape
    return torch.stack(summed)[:, :depth, :height, :width]


@functools.lru_cache(maxsize=8)
@torch.inference_mode(False)
def _even_potential(grid: Grid, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The potential of a mass of 1 in every cell, `[1, z, y, x]`."""
    return potential(torch.ones(1, *grid.shape, dtype=dtype, device=device), grid)


@functools.lru_cache(maxsize=8)
@torch.inference_mode(False)
def _spectrum(grid: Grid, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The Fourier transform of 1 / distance, averaged over cells, in a box twice as wide."""
    # mean over a cell = sum over its corners, at x, y, z, of these terms (MacMillan 1930, ch. 2)
    corners = []
    for n, step in zip(grid.shape, grid.spacing, strict=True):
        centers = torch.fft.fftfreq(2 * n, 1 / (2 * n * step), dtype=torch.float64)
        corners.append(torch.stack([centers + step / 2, centers - step / 2]))
    # Fields [2, z, 2, y, 2, x] that vary along an axis alone.
    z, y, x = (
        line.view(*[1, 1] * axis, *line.shape, *[1, 1] * (2 - axis))
        for axis, line in enumerate(corners)
    )
    radius = (z * z + y * y + x * x).sqrt()
    terms = torch.zeros_like(radius)
    for a, b, c in ((z, y, x), (y, x, z), (x, z, y)):
        terms += a * b * torch.asinh(c / torch.hypot(a, b))
        terms -= a**2 / 2 * torch.atan(b * c / (a * radius))
    kernel = -terms.diff(1, 0).diff(1, 2).diff(1, 4).squeeze((0, 2, 4)) / math.prod(grid.spacing)
    return torch.fft.rfftn(kernel.to(device, dtype))


CLOSURES = {"geometric": geometric, "smooth": smooth}


@dataclass(frozen=True)
class Closure:
    """The closure called `name` on `grid`, as a function of the transport extinction."""

    name: str
    grid: Grid

    def __call__(self, transport_extinction: Tensor) -> Tensor:
        return CLOSURES[self.name](transport_extinction, self.grid)
