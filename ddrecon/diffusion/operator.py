"""The conservative diffusion operator A = G^T c G + loss (docs/theory.md E7) on cell-centered
arrays `[C, z, y, x]`.

G is the difference of neighboring cells across each interior face, c the conductance of that face;
`loss` is what a cell gives up to absorption and through the faces of the box. Every flux that
leaves a cell enters its neighbor, so energy is kept to rounding. Neighbors are combined by slicing:
conv3d with fixed difference kernels gives the same result 30 to 50 times slower on a CPU
(`benchmarks/stencil.py` measures both).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.numerics.autodiff import keep

Made = TypeVar("Made")
AXES = (1, 2, 3)
"""Array axes of z, y, x in a `[C, z, y, x]` tensor."""


@dataclass(frozen=True)
class Operator:
    """A symmetric positive definite M-matrix per color.

    `conductances`: c [1/u] on the interior faces along z, y, x, each one entry shorter than a cell
    array along its axis; `loss` [1/u]: `[C, z, y, x]`, >= 0 and somewhere > 0. Conductances that
    all colors share may be given once. `made`: what solvers have made of these numbers; to be
    handed on with them only.
    """

    conductances: tuple[Tensor, Tensor, Tensor]
    loss: Tensor
    made: dict[Callable[[Operator], Any], Any] = field(
        default_factory=dict, repr=False, compare=False
    )

    @cached_property
    def diagonal(self) -> Tensor:
        """The diagonal of A [1/u]."""
        total = self.loss.clone()
        for axis, conductance in zip(AXES, self.conductances, strict=True):
            lower_cells(total, axis).add_(conductance)
            upper_cells(total, axis).add_(conductance)
        return total

    def apply(self, u: Tensor) -> Tensor:
        """A u, `[C, z, y, x]`."""
        return subtract_neighbors(self.diagonal * u, u, self.conductances)

    def once(self, make: Callable[[Operator], Made]) -> Made:
        """What `make` makes of this operator, made when first asked for and kept: forward and
        adjoint solves share it.
        """
        if make not in self.made:
            self.made[make] = make(self)
        return self.made[make]


def lower_cells(u: Tensor, axis: int) -> Tensor:
    """The cells on the low side of every interior face along `axis` (a view)."""
    return u.narrow(axis, 0, u.shape[axis] - 1)


def upper_cells(u: Tensor, axis: int) -> Tensor:
    """The cells on the high side of every interior face along `axis` (a view)."""
    return u.narrow(axis, 1, u.shape[axis] - 1)


def difference(u: Tensor, axis: int) -> Tensor:
    """G u along `axis`: high side minus low side of every interior face."""
    return upper_cells(u, axis) - lower_cells(u, axis)


def subtract_neighbors(
    result: Tensor, u: Tensor, conductances: tuple[Tensor, ...], times: float = 1.0
) -> Tensor:
    """`result` minus `times` conductance times neighbor, over all interior faces; `result` is
    changed in place and returned.
    """
    for axis, conductance in zip(AXES, conductances, strict=True):
        lower_cells(result, axis).addcmul_(conductance, upper_cells(u, axis), value=-times)
        upper_cells(result, axis).addcmul_(conductance, lower_cells(u, axis), value=-times)
    return result


def accumulate(faces: Tensor, axis: int) -> Tensor:
    """G^T f along `axis`: each cell gets what its low face brings minus what its high face brings."""
    nothing = faces.new_zeros(_with(faces.shape, axis, 1))
    return torch.cat([nothing, faces], axis) - torch.cat([faces, nothing], axis)


def conductance(diffusion: Tensor, grid: Grid, axis: int) -> Tensor:
    """c = harmonic mean of D on the interior faces along `axis` / h^2 [1/u] (E7); `diffusion`: D
    [u], `[C, z, y, x]`, > 0.
    """
    return harmonic_mean(diffusion, axis) / grid.spacing[axis - 1] ** 2


def harmonic_mean(u: Tensor, axis: int) -> Tensor:
    """The harmonic mean (E7) of the cells on both sides of every interior face along `axis`, in the
    units of `u`: `[C, z, y, x]`, > 0.

    One entry shorter than `u` along `axis`.
    """
    mean: Tensor = _HarmonicMean.apply(u, axis)
    return mean


class _HarmonicMean(torch.autograd.Function):
    """Differentiated by hand, d mean = mean^2 / 2 (da / a^2 + db / b^2): keeps one array beside
    `u`, autograd five.
    """

    @staticmethod
    def forward(u: Tensor, axis: int) -> Tensor:
        return (
            lower_cells(u, axis)
            .reciprocal()
            .add_(upper_cells(u, axis).reciprocal())
            .reciprocal_()
            .mul_(2)
        )

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, int], output: Tensor) -> None:
        u, ctx.axis = inputs
        keep(ctx, u, output)

    @staticmethod
    def backward(ctx: Any, mean_bar: Tensor) -> tuple[Tensor, None]:
        u, mean = ctx.saved_tensors
        half = 0.5 * mean_bar * mean * mean
        u_bar = torch.zeros_like(u)
        for side in (lower_cells, upper_cells):
            side(u_bar, ctx.axis).addcdiv_(half, side(u, ctx.axis) ** 2)
        return u_bar, None

    @staticmethod
    def jvp(ctx: Any, d_u: Tensor, _: None) -> Tensor:
        u, mean = ctx.saved_tensors
        change = sum(
            side(d_u, ctx.axis) / side(u, ctx.axis) ** 2 for side in (lower_cells, upper_cells)
        )
        return 0.5 * mean * mean * change


def boundary_loss(diffusion: Tensor, grid: Grid) -> Tensor:
    """What a cell loses through the faces of the box per unit L0 [1/u]: 1 / (h (2 + h / (2 D))) for
    each such face (Marshak, E6).
    """
    loss = torch.zeros_like(diffusion)
    for axis, step in zip(AXES, grid.spacing, strict=True):
        for end in (_first, _last):
            end(loss, axis).add_(_escape(end(diffusion, axis), step) / step)
    return loss


def face_fluxes(
    radiance: Tensor | None,
    source_flux: Tensor | None,
    diffusion: Tensor,
    grid: Grid,
    axis: int,
    outside: Tensor | None = None,
) -> Tensor:
    """Flux F = D (-grad L0 + kappa_s Q1) along `axis` on all faces, those of the box included (E5
    without its 3, and E6).

    `radiance`: L0 [C, z, y, x]; `source_flux`: the component of kappa_s Q1 along `axis`, same
    shape; `outside`: the radiance [C, 1, 1, 1] that enters from outside the box, the same from
    everywhere; None for zero. Returns an array one entry longer than the cells along `axis`,
    positive towards higher indices.
    """
    step = grid.spacing[axis - 1]
    low = inside = high = diffusion.new_zeros(())
    if radiance is not None:
        low, inside, high = (
            -_first(radiance, axis),
            difference(radiance, axis) / -step,
            _last(radiance, axis),
        )
    if source_flux is not None:
        low, high = (
            side + step / 2 * end(source_flux, axis) for side, end in ((low, _first), (high, _last))
        )
        inside = inside + 0.5 * (lower_cells(source_flux, axis) + upper_cells(source_flux, axis))
    if outside is not None:
        low, high = low + outside, high - outside
    into, out = (_escape(end(diffusion, axis), step) for end in (_first, _last))
    return torch.cat([into * low, harmonic_mean(diffusion, axis) * inside, out * high], axis)


def cell_average(faces: Tensor, axis: int) -> Tensor:
    """Half the sum of a cell's two faces along `axis`; `faces` is one entry longer there than the
    cells.
    """
    return 0.5 * (lower_cells(faces, axis) + upper_cells(faces, axis))


def _escape(diffusion: Tensor, step: float) -> Tensor:
    """What leaves a cell through a face on the box per unit L0 (Marshak, E6): 1 / (2 + h / (2 D))."""
    return 1 / (2 + step / (2 * diffusion))


def _first(u: Tensor, axis: int) -> Tensor:
    return u.narrow(axis, 0, 1)


def _last(u: Tensor, axis: int) -> Tensor:
    return u.narrow(axis, u.shape[axis] - 1, 1)


def _with(shape: list[int] | torch.Size, axis: int, size: int) -> list[int]:
    return [size if other == axis else old for other, old in enumerate(shape)]
