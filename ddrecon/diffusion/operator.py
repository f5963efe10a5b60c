"""The conservative diffusion operator A = G^T c G + loss (docs/theory.md E2.7).

All arrays hold cells, `[C, z, y, x]`. An array of faces along an axis has the face above each cell,
between it and the next one. The last of them lies between the last cell and the first, which are
neighbors where the axis is periodic; elsewhere it lies on the box and conducts nothing. So periodic
axes need no code of their own. G is the difference of neighboring cells across each face, c the
conductance of that face; `loss` is what a cell gives up to absorption and through the faces of the
box. Every flux that leaves a cell enters its neighbor, so energy is kept to rounding.

Neighbors are combined by shifting: conv3d with fixed difference kernels gives the same result 30 to
50 times slower on a CPU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import torch
from torch import Tensor

from ddrecon.grid import Grid, Triple

Prepared = TypeVar("Prepared")
AXES = (1, 2, 3)
"""Array axes of z, y, x in a `[C, z, y, x]` tensor."""


@dataclass(frozen=True)
class Operator:
    """A symmetric positive definite M-matrix per color.

    `conductances`: c [1/u] on the faces above cells along z, y, x, `[C, z, y, x]`; zero on the box
    and along axes of a single cell. `loss` [1/u]: `[C, z, y, x]`, >= 0 and somewhere > 0.
    Conductances that all colors share may be given once. `periodic`: the axes, 0 to 2, along which
    the last face may conduct: kernels do not look past the ends of others. `spacing`: that of cells
    along z, y, x, up to a factor. `prepared`: what solvers have computed from these numbers; to be
    handed on with them only.
    """

    conductances: tuple[Tensor, Tensor, Tensor]
    loss: Tensor
    periodic: tuple[int, ...] = ()
    spacing: Triple = (1.0, 1.0, 1.0)
    prepared: dict[Callable[[Operator], Any], Any] = field(
        default_factory=dict, repr=False, compare=False
    )

    @staticmethod
    def of(
        periodic: tuple[int, ...],
        spacing: Triple,
        prepared: dict[Callable[[Operator], Any], Any],
        loss: Tensor,
        *conductances: Tensor,
    ) -> Operator:
        """The operator of `loss` and three conductances, in the order of its derivatives."""
        z, y, x = conductances
        return Operator((z, y, x), loss, periodic, spacing, prepared)

    @property
    def along_axes(self) -> Iterator[tuple[int, Tensor]]:
        """Each axis with its conductances."""
        return zip(AXES, self.conductances, strict=True)

    @cached_property
    def exchanged(self) -> Tensor:
        """The sum of the conductances of each cell's six faces [1/u]."""
        z, y, x = (c + c.roll(1, axis) for axis, c in self.along_axes)
        return z + y + x

    @cached_property
    def diagonal(self) -> Tensor:
        """The diagonal of A [1/u]."""
        return self.loss + self.exchanged

    def apply(self, u: Tensor) -> Tensor:
        """A u, `[C, z, y, x]`."""
        z, y, x = (accumulate(c * difference(u, axis), axis) for axis, c in self.along_axes)
        return self.loss * u + (z + y + x)

    def once(self, prepare: Callable[[Operator], Prepared]) -> Prepared:
        """`prepare(self)`, computed when first asked for and kept for all solves."""
        if prepare not in self.prepared:
            self.prepared[prepare] = prepare(self)
        return self.prepared[prepare]

    def linearized(self, _: Tensor) -> Operator:
        """The derivative of A u by u, which is A."""
        return self

    def transposed(self) -> Operator:
        """A^T, which is A."""
        return self

    def cotangents(self, adjoint: Tensor, u: Tensor) -> tuple[Tensor, ...]:
        """loss_bar = -lambda u and c_bar = -(G lambda)(G u) of each axis (E3.2)."""
        adjoint = -adjoint
        conductance_bars = (
            difference(adjoint, axis).mul_(difference(u, axis)).sum_to_size(c.shape)
            for axis, c in self.along_axes
        )
        return (adjoint * u).sum_to_size(self.loss.shape), *conductance_bars

    def change(self, d_tensors: Iterable[Tensor], u: Tensor) -> Tensor:
        """dA u = dloss u + G^T (dc G u) of each axis (E3.1)."""
        return Operator.of(self.periodic, self.spacing, {}, *d_tensors).apply(u)


def difference(u: Tensor, axis: int) -> Tensor:
    """G u along `axis`: the cell above minus the cell below each face."""
    return u.roll(-1, axis).sub_(u)


def accumulate(faces: Tensor, axis: int) -> Tensor:
    """G^T f along `axis`: in cells, what the lower face holds minus what the upper one does."""
    return faces.roll(1, axis).sub_(faces)


def conductance(diffusion: Tensor, grid: Grid, axis: int) -> Tensor:
    """c = (harmonic mean of D) / h^2 [1/u] on the faces above cells along `axis` (E2.7).

    `diffusion`: D [u], `[C, z, y, x]`, > 0.
    """
    is_periodic = axis - 1 in grid.periodic and diffusion.shape[axis] > 1
    low, high = _ends(diffusion, axis)
    cells = torch.cat([diffusion, low], axis) if is_periodic else diffusion
    faces = harmonic_mean(cells, axis) / grid.spacing[axis - 1] ** 2
    return faces if is_periodic else torch.cat([faces, torch.zeros_like(high)], axis)


def harmonic_mean(u: Tensor, axis: int) -> Tensor:
    """2 / (1/a + 1/b) of the two cells beside every interior face along `axis` (E2.7).

    `u`: `[C, z, y, x]`, > 0, in any unit; the result has that unit, and one entry less along
    `axis`.
    """
    # Not by reciprocals: the derivative of 1 / a overflows where u is small, and opaque cells are.
    a, b = _neighbors(u, axis)
    return 2 * a * (b / (a + b))


def boundary_loss(diffusion: Tensor, grid: Grid, resistance: float = 2.0) -> Tensor:
    """What a cell loses through the faces of the box, per unit L0 [1/u] (Marshak, E2.6).

    1 / (h (2 + h / (2 D))) for each such face; `diffusion`: D [u], `[C, z, y, x]`; `resistance`: as
    of `escape`.
    """
    loss = torch.zeros_like(diffusion)
    for axis, step in zip(AXES, grid.spacing, strict=True):
        for end in (0, 1) if axis - 1 not in grid.periodic else ():
            lost = escape(_ends(diffusion, axis)[end], step, resistance) / step
            _ends(loss, axis)[end].add_(lost)
    return loss


def face_fluxes(
    radiance: Tensor | None,
    source_flux: Tensor | None,
    diffusion: Tensor,
    grid: Grid,
    axis: int,
    outside: Tensor | None = None,
    resistance: float = 2.0,
) -> Tensor:
    """F = D (-grad L0 + kappa_s Q1) along `axis` on all faces (E2.5 without its 3, and E2.6).

    F is linear in three terms; one that is None is zero. `radiance`: L0 [C, z, y, x];
    `source_flux`: the component of kappa_s Q1 along `axis`, same shape; `outside`: the radiance
    [C, 1, 1, 1] that enters from outside the box, the same from everywhere. `diffusion`: D [u];
    `resistance`: as of `escape`.
    Returns an array one entry longer than the cells along `axis`: the faces of the box come first
    and last, or twice that between a period's ends. Fluxes are positive towards higher indices.
    """
    step, is_periodic = grid.spacing[axis - 1], axis - 1 in grid.periodic
    drive = diffusion.new_zeros(())
    if radiance is not None:
        drive = add_ghosts(radiance, axis, is_periodic, outside).diff(dim=axis) / -step
    if source_flux is not None:
        drive = drive + face_average(add_ghosts(source_flux, axis, is_periodic), axis)
    inside = harmonic_mean(add_ghosts(diffusion, axis, True) if is_periodic else diffusion, axis)
    if is_periodic:
        return inside * drive
    # On the box F = (L0 - outside + (h/2) kappa_s Q1) / (2 + h / (2 D)): with ghost cells that hold
    # what is outside, and no Q1, it is h / (2 + h / (2 D)) times what drives light there.
    into, out = (step * escape(end, step, resistance) for end in _ends(diffusion, axis))
    return torch.cat([into, inside, out], axis) * drive


def add_ghosts(u: Tensor, axis: int, is_periodic: bool, outside: Tensor | None = None) -> Tensor:
    """`u` with a cell more at each end of `axis`: of the other end, or what is `outside`, or 0."""
    low, high = _ends(u, axis)
    if is_periodic:
        return torch.cat([high, u, low], axis)
    ghost = torch.zeros_like(low) if outside is None else outside.expand_as(low)
    return torch.cat([ghost, u, ghost], axis)


def face_average(u: Tensor, axis: int) -> Tensor:
    """The mean of neighbors along `axis`, one entry less: of cells on faces, or the reverse."""
    lower, upper = _neighbors(u, axis)
    return 0.5 * (lower + upper)


def escape(diffusion: Tensor, step: float, resistance: float) -> Tensor:
    """The flux out of a cell at the box, per unit L0: 1 / (2 + h / (2 D)) (Marshak, E2.6).

    `resistance`: in place of the first 2, more where faces reflect light inside (E2.13).
    """
    return diffusion / (resistance * diffusion + step / 2)


def _neighbors(u: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """The cells below and above every interior face along `axis` (views)."""
    count = u.shape[axis] - 1
    return u.narrow(axis, 0, count), u.narrow(axis, 1, count)


def _ends(u: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """The first and the last cells along `axis` (views)."""
    return u.narrow(axis, 0, 1), u.narrow(axis, u.shape[axis] - 1, 1)
