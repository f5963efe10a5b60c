"""Media in finer cells: the same where they are linear, around periods as well."""

from dataclasses import replace

import pytest
import torch
from media import make_scene, random_values

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.grid import Grid
from ddrecon.lighting import fluence
from ddrecon.medium.coefficients import Coefficient, scale_medium
from ddrecon.medium.levels import refine_medium
from ddrecon.numerics.interpolation import sample_volume

SHAPE = 4, 1, 5
GRID = Grid(SHAPE, (-0.4, -0.3, -0.5), (0.4, 0.3, 0.5))


@pytest.mark.parametrize(("times", "along"), [(3, "xyz"), (9, "xyz"), (3, "xy")])
def test_a_finer_medium_has_the_same_values_everywhere(times: int, along: str):
    scene = make_scene(random_values(*SHAPE), sigma_s=random_values(3, *SHAPE, seed=1), grid=GRID)
    medium = scale_medium(scene.volume)
    finer = refine_medium(medium, times, along)
    assert finer.grid.shape == (4 * times if "z" in along else 4, 1, 5 * times)
    points = 2 * random_values(1, 500, 3, seed=2) - 1

    def seen(coefficient: Coefficient) -> torch.Tensor:
        field = coefficient.field
        return sample_volume(field, points.expand(1, -1, -1))

    for name in ("extinction", "scattering", "absorption"):
        torch.testing.assert_close(seen(getattr(finer, name)), seen(getattr(medium, name)))


def test_a_finer_medium_is_as_empty_beyond_its_support():
    support = random_values(*SHAPE, seed=3) > 0.5
    scene = make_scene(random_values(*SHAPE), grid=GRID)
    within = replace(scene.volume, support=support)
    emptied = replace(scene.volume, density=scene.volume.density * support)
    finer, same = (refine_medium(scale_medium(volume), 3) for volume in (within, emptied))
    torch.testing.assert_close(finer.extinction.value, same.extinction.value)


def test_a_finer_medium_that_repeats_has_no_seam():
    grid = replace(GRID, periodic=(2,))
    scene = make_scene(random_values(*SHAPE), grid=grid)
    turned = make_scene(scene.volume.density.roll(2, 2), grid=grid)
    one, other = (refine_medium(scale_medium(each.volume), 3, "x") for each in (scene, turned))
    torch.testing.assert_close(other.extinction.field, one.extinction.field.roll(6, 3))


def test_fluence_in_finer_cells_is_that_of_cells_as_given():
    """Of even light without absorption it is 4 pi times that, in every cell."""
    options = {"directional": None, "ambient": (0.5,), "sigma_a": (0.0,), "refine": 3}
    scene = make_scene(random_values(*SHAPE), grid=GRID, sigma_s=(9.0,), **options)
    found = fluence(scene, SolveMemory())
    torch.testing.assert_close(found, torch.full((1, *SHAPE), 2 * torch.pi, dtype=torch.float64))
