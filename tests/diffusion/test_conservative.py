"""The conservative scheme: its system and its flux are those put together face by face."""

import itertools
import math

import pytest
import torch
from media import box_grid, dense_matrix, half_empty, random_values
from torch import Tensor

from ddrecon.diffusion.conservative import DiffusionProblem
from ddrecon.light.moments import flux_along_axes
from ddrecon.medium.coefficients import Volume, scale_medium

OUTSIDE = 0.7


def make_problem(shape: tuple[int, int, int], has_flux: bool) -> DiffusionProblem:
    """A gray medium with a beam-like source, in ambient light."""
    sigma, g = torch.tensor([0.5, 6.0], dtype=torch.float64), 0.4 * has_flux
    volume = Volume(box_grid(shape), half_empty(*shape), sigma[:1], sigma[1:], sigma.new_tensor(g))
    source = random_values(4 if has_flux else 1, 1, *shape)
    source[1:] -= 0.5
    outside, medium = torch.full_like(source[0, :, :1, :1, :1], OUTSIDE), scale_medium(volume)
    return DiffusionProblem(medium, lambda k: 1 / (3 * k + 0.5), source, outside, has_flux)


class FaceByFace:
    """Outward fluxes of a problem, F . n = `own` u(cell) + `other` u(neighbor) + `known` (E2.6)."""

    def __init__(self, problem: DiffusionProblem):
        self.problem, self.shape = problem, problem.medium.grid.shape
        self.diffusion = problem.diffusion[0]
        scattering = problem.medium.remaining_scattering[0]
        self.gain = scattering * problem.source[0, 0]
        first = (
            problem.source[1:]
            if len(problem.source) > 1
            else 0 * problem.source.expand(3, -1, -1, -1, -1)
        )
        flux = flux_along_axes(first)
        self.scattered = [scattering * component[0] for component in flux]

    def neighbor(self, cell: tuple[int, ...], axis: int, side: int) -> tuple[int, ...] | None:
        beside = tuple(i + side * (a == axis) for a, i in enumerate(cell))
        return beside if 0 <= beside[axis] < self.shape[axis] else None

    def flux(self, cell: tuple[int, ...], axis: int, side: int) -> tuple[Tensor, Tensor, Tensor]:
        h, d, q = self.problem.medium.grid.spacing[axis], self.diffusion, self.scattered[axis]
        beside = self.neighbor(cell, axis, side)
        if beside is None:  # Marshak's condition on the box
            escape = 1 / (2 + h / (2 * d[cell]))
            known = escape * (side * h / 2 * q[cell] - OUTSIDE)
            return escape, torch.zeros_like(escape), known
        mean = 2 / (1 / d[cell] + 1 / d[beside])
        return mean / h, -mean / h, side * mean * (q[cell] + q[beside]) / 2

    def system(self) -> tuple[Tensor, Tensor]:
        """The matrix [n, n] and right side [n] of E2.4: outflow + kappa_a u = kappa_s Q0."""
        number = {c: n for n, c in enumerate(itertools.product(*map(range, self.shape)))}
        absorption, spacing = (
            self.problem.medium.absorption.value[0],
            self.problem.medium.grid.spacing,
        )
        matrix = torch.zeros(len(number), len(number), dtype=torch.float64)
        right = self.gain.flatten().clone()
        for cell, row in number.items():
            matrix[row, row] += absorption[cell]
            for axis, side in itertools.product(range(3), (-1, 1)):
                h, (own, other, known) = spacing[axis], self.flux(cell, axis, side)
                matrix[row, row] += own / h
                right[row] -= known / h
                if (beside := self.neighbor(cell, axis, side)) is not None:
                    matrix[row, number[beside]] += other / h
        return matrix, right

    def mean_flux(self, u: Tensor, axis: int) -> Tensor:
        """L1 = 3 F along `axis`, the mean of both faces of every cell (E2.5)."""
        total = torch.zeros_like(u)
        for cell, side in itertools.product(itertools.product(*map(range, self.shape)), (-1, 1)):
            own, other, known = self.flux(cell, axis, side)
            beside = self.neighbor(cell, axis, side)
            outward = own * u[cell] + known + (0 if beside is None else other * u[beside])
            total[cell] += 3 * side * outward / 2
        return total


@pytest.mark.parametrize("has_flux", [False, True])
@pytest.mark.parametrize("shape", [(3, 2, 4), (1, 3, 1), (1, 1, 1)], ids=str)
def test_the_system_is_that_put_together_face_by_face(shape: tuple[int, int, int], has_flux: bool):
    problem = make_problem(shape, has_flux)
    operator, right = problem.system
    matrix, expected = FaceByFace(problem).system()
    torch.testing.assert_close(dense_matrix(operator)[0], matrix, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(right.flatten(), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("shape", [(3, 2, 4), (1, 3, 1)], ids=str)
def test_the_flux_is_that_of_each_cells_two_faces(shape: tuple[int, int, int]):
    problem, u = make_problem(shape, True), random_values(1, *shape, seed=7)
    found = problem.flux(u)
    assert found is not None and math.prod(shape) == u.numel()
    for axis, component in enumerate(flux_along_axes(found)):
        expected = FaceByFace(problem).mean_flux(u[0], axis)
        torch.testing.assert_close(component[0], expected, rtol=1e-12, atol=1e-12)
