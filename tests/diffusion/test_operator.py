"""The conservative scheme: matrix, right side and flux face by face, energy, second order."""

import itertools
import math

import pytest
import torch
from media import (
    box_grid,
    convergence_order,
    dense_matrix,
    half_empty,
    make_operator,
    random_values,
    tensor,
)

from ddrecon.diffusion.conservative import DiffusionProblem
from ddrecon.diffusion.operator import AXES, face_fluxes
from ddrecon.diffusion.solve import solve_by_multigrid
from ddrecon.grid import Grid
from ddrecon.light.moments import flux_along_axes
from ddrecon.medium.coefficients import Volume, scale_medium

SHAPES = [(4, 3, 5), (1, 4, 3), (3, 1, 4), (4, 3, 1), (1, 1, 5), (1, 1, 1)]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_the_operator_is_the_matrix_written_with_loops(shape):
    """Of diffusion coefficients over four decades, in two colors."""
    diffusion = 10 ** (4 * random_values(2, *shape, seed=1) - 3)
    operator = make_operator(box_grid(shape), diffusion, random_values(2, *shape, seed=2))
    u, matrix = random_values(*operator.loss.shape), dense_matrix(operator)
    expected = (matrix @ u.flatten(1)[..., None]).view_as(u)
    torch.testing.assert_close(operator.apply(u), expected, rtol=1e-13, atol=1e-13)
    diagonal = torch.linalg.diagonal(matrix)
    torch.testing.assert_close(operator.diagonal.flatten(1), diagonal, rtol=1e-14, atol=0)


D_AT_FACES = 0.2
EXTENT = (1.0, 1.2, 0.8)


def manufactured(position):
    """L0, D, kappa_a, kappa_s Q0, kappa_s Q1 and L1 at (z, y, x) that fulfill E2.4-E2.6.

    Along each axis L0 is 1 + t (L - t) / (2 D L), so that L0 / 2 = -D dL0/dn on both faces, where D
    is D_AT_FACES but not flat, and where Q1 runs along the face.
    """
    z, y, x = (axis.clone().requires_grad_() for axis in position)
    u, bump = torch.ones_like(z), torch.ones_like(z)
    for t, length in zip((z, y, x), EXTENT, strict=True):
        u = u * (1 + t * (length - t) / (2 * D_AT_FACES * length))
        bump = bump * torch.sin(math.pi * t / length)
    diffusion, absorption = D_AT_FACES * (1 + bump), 1 + torch.cos(z) * y
    slopes = torch.autograd.grad(u.sum(), (z, y, x), create_graph=True)
    flux, moved, injected = [], [], absorption * u
    for t, length, slope in zip((z, y, x), EXTENT, slopes, strict=True):
        flux.append(torch.sin(math.pi * t / length) * (1 + x * y))
        moved.append(diffusion * (flux[-1] - slope))
        injected = injected + torch.autograd.grad(moved[-1].sum(), t, retain_graph=True)[0]
    fields = [u, diffusion, absorption, injected, *flux, *(3 * component for component in moved)]
    return tuple(field.detach()[None] for field in fields)


def discrete_error(cells):
    grid = Grid((cells, cells, cells // 2), (0.0, 0.0, 0.0), EXTENT)
    u, diffusion, absorption, source, *flux = manufactured(
        torch.broadcast_tensors(*grid.centers(tensor(0)))
    )
    for axis in AXES:
        faces = face_fluxes(None, flux[axis - 1], diffusion, grid, axis)
        source = source - faces.diff(dim=axis) / grid.spacing[axis - 1]
    operator = make_operator(grid, diffusion, absorption)
    error = solve_by_multigrid(operator, source, None, 1e-11).value - u
    return float((error**2).mean().sqrt() / (u**2).mean().sqrt())


def test_a_manufactured_solution_is_approached_at_second_order():
    counts = [8, 16, 32]
    errors = [discrete_error(cells) for cells in counts]
    assert convergence_order([1 / cells for cells in counts], errors) >= 1.9, errors


OUTSIDE = 0.7
PROBLEMS = [(3, 2, 4), (1, 3, 1), (1, 1, 1)]


def make_problem(shape, has_flux):
    """A gray medium with a beam-like source, in ambient light."""
    sigma, g = torch.tensor([0.5, 6.0], dtype=torch.float64), 0.4 * has_flux
    volume = Volume(box_grid(shape), half_empty(*shape), sigma[:1], sigma[1:], sigma.new_tensor(g))
    source = random_values(4 if has_flux else 1, 1, *shape)
    source[1:] -= 0.5
    outside, medium = torch.full_like(source[0, :, :1, :1, :1], OUTSIDE), scale_medium(volume)
    return DiffusionProblem(medium, lambda k: 1 / (3 * k + 0.5), source, outside, has_flux)


class FaceByFace:
    """Outward fluxes of a problem, F . n = `own` u(cell) + `other` u(neighbor) + `known` (E2.6)."""

    def __init__(self, problem):
        self.problem, self.shape = problem, problem.medium.grid.shape
        self.diffusion = problem.diffusion[0]
        scattering = problem.medium.remaining_scattering[0]
        self.gain = scattering * problem.source[0, 0]
        first = problem.source[1:]
        flux = flux_along_axes(
            first if len(first) else 0 * problem.source.expand(3, -1, -1, -1, -1)
        )
        self.scattered = [scattering * component[0] for component in flux]

    def neighbor(self, cell, axis, side):
        beside = tuple(i + side * (a == axis) for a, i in enumerate(cell))
        return beside if 0 <= beside[axis] < self.shape[axis] else None

    def flux(self, cell, axis, side):
        h, d, q = self.problem.medium.grid.spacing[axis], self.diffusion, self.scattered[axis]
        beside = self.neighbor(cell, axis, side)
        if beside is None:  # Marshak's condition on the box
            escape = 1 / (2 + h / (2 * d[cell]))
            known = escape * (side * h / 2 * q[cell] - OUTSIDE)
            return escape, torch.zeros_like(escape), known
        mean = 2 / (1 / d[cell] + 1 / d[beside])
        return mean / h, -mean / h, side * mean * (q[cell] + q[beside]) / 2

    def system(self):
        """The matrix [n, n] and right side [n] of E2.4: outflow + kappa_a u = kappa_s Q0."""
        number = {c: n for n, c in enumerate(itertools.product(*map(range, self.shape)))}
        medium = self.problem.medium
        absorption, spacing = medium.absorption.value[0], medium.grid.spacing
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

    def mean_flux(self, u, axis):
        """L1 = 3 F along `axis`, the mean of both faces of every cell (E2.5)."""
        total = torch.zeros_like(u)
        for cell, side in itertools.product(itertools.product(*map(range, self.shape)), (-1, 1)):
            own, other, known = self.flux(cell, axis, side)
            beside = self.neighbor(cell, axis, side)
            outward = own * u[cell] + known + (0 if beside is None else other * u[beside])
            total[cell] += 3 * side * outward / 2
        return total


@pytest.mark.parametrize("has_flux", [False, True])
@pytest.mark.parametrize("shape", PROBLEMS, ids=str)
def test_the_system_is_that_put_together_face_by_face(shape, has_flux):
    problem = make_problem(shape, has_flux)
    operator, right = problem.system
    matrix, expected = FaceByFace(problem).system()
    torch.testing.assert_close(dense_matrix(operator)[0], matrix, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(right.flatten(), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("shape", PROBLEMS, ids=str)
def test_the_flux_is_that_of_each_cells_two_faces(shape):
    problem, u = make_problem(shape, True), random_values(1, *shape, seed=7)
    for axis, component in enumerate(flux_along_axes(problem.flux(u))):
        expected = FaceByFace(problem).mean_flux(u[0], axis)
        torch.testing.assert_close(component[0], expected, rtol=1e-12, atol=1e-12)
