"""The metric of fields: random pictures tell the diagonal of the whole matrix, on average."""

from dataclasses import replace
from itertools import product

import pytest
import torch
from media import data_product, make_camera, make_scene, random_values

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.losses import Target
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.metric import find_diagonals
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.scene import View
from ddrecon.settings import ParameterSettings
from ddrecon.uncertainty.curvature import Curvature
from ddrecon.variables.values import value_of

SHAPE = (3, 4, 3)
NAMES = ("density", "g")


@pytest.fixture(scope="module")
def curvature() -> Curvature:
    """Two views, one of which counts twice and sees a part, of a volume and its g."""
    base = make_scene(0.3 + random_values(*SHAPE), g=0.3, transport_rounds=0)
    images = random_values(2, 3, 4, 5, seed=2)
    one = View("one", make_camera((0.2, 0.3, 2.5)), images[0])
    two = View("two", make_camera((2.4, -0.3, 0.5)), images[1], weight=2.0)
    two = replace(two, mask=random_values(4, 5, seed=4).round())
    scene = replace(base, views=[one, two])
    grid = scene.volume.grid
    parameters = [Parameter(n, ParameterSettings(), value_of(scene, n), grid) for n in NAMES]
    targets = {view.name: Target.of(view.image, view.mask) for view in scene.views}
    return Curvature(scene, parameters, targets)


def diagonal_by(curvature: Curvature, probes: int, monkeypatch: pytest.MonkeyPatch) -> torch.Tensor:
    monkeypatch.setattr(tuning, "PROBES", probes)
    arguments = curvature.parameters[:1], curvature.values, curvature.weights, SolveMemory()
    return find_diagonals(curvature.scene, *arguments)["density"]


def test_it_is_the_mean_of_the_true_diagonal_over_neighbors(
    curvature: Curvature, monkeypatch: pytest.MonkeyPatch
) -> None:
    cells = [curvature.join({"density": cell.view(SHAPE)}) for cell in torch.eye(36).double()]
    true = torch.stack([cell @ data_product(curvature, cell) for cell in cells]).view(SHAPE)
    wanted = torch.zeros_like(true)
    for z, y, x in product(*map(range, SHAPE)):
        around = (slice(max(0, at - 1), at + 2) for at in (z, y, x))
        wanted[z, y, x] = true[tuple(around)].mean()
    errors = [
        float((diagonal_by(curvature, probes, monkeypatch) / wanted - 1).square().mean().sqrt())
        for probes in (8, 128)
    ]
    assert errors[1] < 0.15 and errors[1] < 0.5 * errors[0]


def test_what_no_picture_shows_is_held_by_a_part_of_what_they_show(
    curvature: Curvature, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tuning, "FLOOR", 0.0)
    bare = diagonal_by(curvature, 1, monkeypatch)
    least = 0.9 * float(bare.square().mean().sqrt())
    monkeypatch.setattr(tuning, "FLOOR", 0.9)
    torch.testing.assert_close(diagonal_by(curvature, 1, monkeypatch), bare.clamp(min=least))
    assert bool((bare < least).any())
