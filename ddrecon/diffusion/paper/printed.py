"""The paper's own scheme, for the record: central differences (Eq. 22-25) and Algorithm 3.

With kappa = 3 D and the corrections of docs/theory.md, section 4, the balance E2.4 reads
grad kappa . grad L0 + kappa lap L0 - 3 kappa_a L0 + S = 0 with
S = 3 kappa_s Q0 - div(kappa kappa_s Q1).

The paper names no boundary condition; here ghost cells around the box hold what Marshak's E2.6 asks
for. The scheme neither conserves energy nor has a symmetric matrix, and its iteration may diverge
where kappa changes abruptly: every surface against empty space.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import ImplicitSolve, SolverWithMemory
from ddrecon.diffusion.paper.operator import (
    PrintedOperator,
    Stencils,
    convolve,
    divergence,
    extend,
    outward,
)
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium


def solve_printed(
    medium: Medium,
    diffusion: Tensor,
    scattered: Moments,
    outside: Tensor,
    solve: SolverWithMemory,
    has_flux: bool,
) -> Moments:
    """L0 by Eq. 25 and, where it `has_flux`, L1 = kappa (-grad L0 + kappa_s Q1) by Eq. 5.

    `diffusion`: D [u], `[C, z, y, x]`; `scattered`: kappa_s Q0 and kappa_s Q1; `outside`: ambient
    radiance `[C, 1, 1, 1]`, which enters through the ghost cells. `solve` must use
    `iterate_jacobi`.
    """
    kappa = 3 * diffusion
    stencils = Stencils.on(medium.grid, kappa)
    ghosts = Ghosts.of(kappa, scattered, outside, stencils)
    diagonal = 3 * medium.absorption.value + kappa * sum(
        2 / step**2 for step in medium.grid.spacing
    )
    operator = PrintedOperator(
        stencils, diagonal, convolve(extend(kappa), stencils.coefficients), ghosts.echo
    )
    # What ghost cells hold by themselves is known, so it stands on the right side.
    entering = (operator.coefficients * convolve(ghosts.inflow, stencils.terms)).sum(1)
    # S = 3 kappa_s Q0 - div(kappa kappa_s Q1)
    source, flux = 3 * scattered.mean + entering, scattered.flux
    if flux is not None:
        source = source - divergence([kappa * component for component in flux], stencils)
    mean = solve_printed_system(solve, operator, source)
    if not has_flux:
        return Moments(mean)
    gradient = convolve(ghosts.echo * extend(mean) + ghosts.inflow, stencils.gradient)
    driving = -gradient if flux is None else torch.stack(flux, 1) - gradient
    z, y, x = (kappa[:, None] * driving).unbind(1)
    return Moments(mean, (z, y, x))


def solve_printed_system(
    solve: SolverWithMemory, operator: PrintedOperator, source: Tensor
) -> Tensor:
    """u with `operator` u = `source` [C, z, y, x], differentiable in both modes (E3.1, E3.2).

    E3.1 is Eq. 29 here. By `source` and by the tensors of `operator`; one of one color serves a
    source of several.
    """
    stencils = operator.stencils

    def assemble(
        _: object, diagonal: Tensor, coefficients: Tensor, echo: Tensor
    ) -> PrintedOperator:
        return PrintedOperator(stencils, diagonal, coefficients, echo)

    tensors = (
        tensor.expand(source.shape[0], *tensor.shape[1:])
        for tensor in (operator.diagonal, operator.coefficients, operator.echo)
    )
    return ImplicitSolve.apply(solve, assemble, {}, source, *tensors)


@dataclass(frozen=True)
class Ghosts:
    """Marshak's condition E2.6 in ghost cells: L0 there = `echo` L0 of the neighbor + `inflow`.

    Both `[C, z + 2, y + 2, x + 2]`; 1 and 0 inside the box. Half a cell from either center, on the
    face, D (-grad L0 + kappa_s Q1) . n = (L0 - outside) / 2, with the mean of the two cells for L0,
    their difference for its gradient, and D and Q1 of the cell in the box.
    """

    echo: Tensor
    inflow: Tensor

    @staticmethod
    def of(kappa: Tensor, scattered: Moments, outside: Tensor, stencils: Stencils) -> Ghosts:
        """Those of a medium of `kappa` in which kappa_s Q0 and kappa_s Q1 are `scattered`.

        `outside` [C, 1, 1, 1]: the radiance around the box.
        """
        normals, kappa = outward(kappa), extend(kappa)
        # h along the normal; 0 in the box, where `echo` becomes 1 and `inflow` 0
        step = (normals.abs() * normals.new_tensor(stencils.grid.spacing).view(3, 1, 1, 1)).sum(0)
        # 6 L + 4 kappa kappa_s Q1 . n
        drive = 6 * outside * torch.ones_like(kappa)
        for normal, component in zip(
            normals, scattered.flux or (), strict=scattered.flux is not None
        ):
            drive = drive + 4 * kappa * normal * extend(component)
        return Ghosts(
            (4 * kappa - 3 * step) / (4 * kappa + 3 * step), step * drive / (4 * kappa + 3 * step)
        )
