"""What pictures say of fields and of single numbers, against products with the whole matrix."""

from dataclasses import dataclass, replace
from itertools import product

import pytest
import torch
from media import box_grid, data_matrix, make_camera, make_scene, random_values

from ddrecon.losses import Target
from ddrecon.picture import render
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.metric import (
    Numbers,
    Point,
    apply_metric,
    find_diagonals,
    find_matrix,
)
from ddrecon.reconstruct.parameters import Parameter, total_variation
from ddrecon.scene import Scene, View
from ddrecon.settings import ParameterSettings
from ddrecon.variables.values import value_of, with_values

CELLS = (3, 3, 3)
NAMES = "lights.0.irradiance", "density", "g", "views.one.camera"
NAMES += "views.two.exposure", "views.two.offset"


@dataclass
class Curvature:
    """The whole `matrix` at the `values` of `parameters`, whose entries follow in their order."""

    scene: Scene
    parameters: list[Parameter]
    values: dict[str, torch.Tensor]
    weights: dict[str, torch.Tensor]
    matrix: torch.Tensor

    def places(self, name):
        """The rows of the entries of `name`."""
        sizes = [value.numel() for value in self.values.values()]
        start = sum(sizes[: [*self.values].index(name)])
        return [*range(start, start + self.values[name].numel())]


@pytest.fixture(scope="module")
def curvature():
    """Two views, of which one moves its camera and the other is exposed, in light of one number."""
    density = 0.3 + random_values(*CELLS)
    base = make_scene(density, g=0.3, ambient=(0.2, 0.3, 0.4), transport_rounds=0)
    images = random_values(2, 3, 4, 5, seed=2)
    one = View("one", make_camera((0.2, 0.3, 2.5)), images[0])
    two = View("two", make_camera((2.4, -0.3, 0.5)), images[1], weight=2.0)
    two = replace(two, exposure=density.new_tensor([1.1, 1.2, 0.9]), offset=density.new_zeros(1))
    scene = replace(base, views=[one, two])
    parameters = [
        Parameter(name, ParameterSettings(), value_of(scene, name), scene.volume.grid)
        for name in NAMES
    ]
    # Twists are about cameras as they were told: the derivative is where it has moved to.
    parameters[3].value = 0.02 * random_values(6, seed=3)
    values = {p.name: p.value for p in parameters}
    shown = dict(zip(("one", "two"), render(with_values(scene, values)), strict=True))
    weights = {
        view.name: view.weight / 3 * Target.of(view.image, None).weights_at(shown[view.name])
        for view in scene.views
    }
    matrix = data_matrix(scene, values, weights)
    return Curvature(scene, parameters, values, weights, matrix)


@pytest.mark.slow
def test_it_is_the_part_of_the_matrix_between_numbers(curvature, monkeypatch):
    """By differences: to first order in how long these are."""
    numbers = Numbers(curvature.scene, curvature.parameters).places
    assert [number.name for number in numbers] == [name for name in NAMES if name != "density"]
    rows = [row for number in numbers for row in curvature.places(number.name)]
    wanted = curvature.matrix[rows][:, rows]
    size = wanted.diagonal().sqrt()
    point = Point(curvature.scene, curvature.values, curvature.weights, {})
    monkeypatch.setattr(tuning, "CLOSE", 1e-10)
    errors = []
    for apart in (1e-3, 2e-3):
        monkeypatch.setattr(tuning, "APART", apart)
        errors.append((find_matrix(point, numbers) - wanted) / size / size[:, None])
    torch.testing.assert_close(errors[1], 2 * errors[0], rtol=0, atol=1e-5)
    assert errors[0].abs().max() < 1e-3


def diagonal_by(curvature, probes, monkeypatch):
    monkeypatch.setattr(tuning, "PROBES", probes)
    monkeypatch.setattr(tuning, "POWER", 1.0)
    point = Point(curvature.scene, curvature.values, curvature.weights, {})
    return find_diagonals(point, [curvature.parameters[1]])["density"]


@pytest.mark.slow
def test_it_is_the_mean_of_the_true_diagonal_over_neighbors(curvature, monkeypatch):
    true = curvature.matrix.diagonal()[curvature.places("density")].view(CELLS)
    wanted = torch.zeros_like(true)
    for z, y, x in product(*map(range, CELLS)):
        around = (slice(max(0, at - 1), at + 2) for at in (z, y, x))
        wanted[z, y, x] = true[tuple(around)].mean()
    errors = [
        float((diagonal_by(curvature, probes, monkeypatch) / wanted - 1).square().mean().sqrt())
        for probes in (4, 64)
    ]
    assert errors[1] < 0.15 and errors[1] < 0.5 * errors[0]


def test_what_no_picture_shows_is_held_by_a_part_of_what_they_show(curvature, monkeypatch):
    monkeypatch.setattr(tuning, "FLOOR", 0.0)
    bare = diagonal_by(curvature, 1, monkeypatch)
    least = 0.9 * float(bare.square().mean().sqrt())
    monkeypatch.setattr(tuning, "FLOOR", 0.9)
    torch.testing.assert_close(diagonal_by(curvature, 1, monkeypatch), bare.clamp(min=least))
    assert bool((bare < least).any())


@pytest.mark.parametrize(("name", "colors"), [("density", ()), ("emission", (3,))])
def test_a_field_moves_by_the_inverse_of_its_metric_where_it_is_free(name, colors, monkeypatch):
    """Against the dense matrix: H plus the curvature of smoothing, of free rows and columns."""
    monkeypatch.setattr(tuning, "CYCLES", 30)
    monkeypatch.setattr(tuning, "HELD", 1e9)
    shape, weight, grid = (*colors, 4, 5, 6), 0.5, box_grid((4, 5, 6))
    knee = 0.5 + random_values(4, 5, 6, seed=4)
    value = (0.3 * knee).expand(shape).contiguous()  # even, once it is compressed
    parameter = Parameter(name, ParameterSettings(tv=0.1), value, grid, unit=0.7)
    diagonal, residuals = 1e-3 + random_values(*shape), random_values(2, *shape, seed=2)
    free = (random_values(*shape, seed=3) > 0.3).double()

    def smoothing(x):
        return 0.1 * total_variation(x.view(shape) / 0.7, grid, knee)

    curvature = torch.autograd.functional.hessian(smoothing, value.flatten())
    matrix, at = diagonal.flatten().diag() + weight * curvature, free.flatten().nonzero()[:, 0]
    wanted = torch.zeros(2, value.numel()).double()
    wanted[:, at] = torch.linalg.solve(matrix[at[:, None], at], residuals.flatten(1)[:, at].T).T
    moves = apply_metric(parameter, value, knee, diagonal, weight, free, residuals)
    torch.testing.assert_close(moves.flatten(1), wanted, rtol=1e-5, atol=1e-7)
