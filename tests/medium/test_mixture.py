"""Two media in the same place, and media in finer cells, around periods as well."""

from dataclasses import replace

import pytest
import torch
from media import box_grid, make_scene, random_values, tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.grid import Grid
from ddrecon.lighting import fluence
from ddrecon.medium.coefficients import (
    Volume,
    mix_media,
    refine_medium,
    scale_medium,
    volume_at_level,
)
from ddrecon.medium.phase import HenyeyGreenstein, Rayleigh
from ddrecon.numerics.interpolation import sample_volume
from ddrecon.picture import render
from ddrecon.reconstruct.setup import scene_at_level
from ddrecon.variables.values import value_of, variable_names, with_values

SHAPE = (4, 5, 6)


def medium(seed, sigma_s, g):
    phase = HenyeyGreenstein(tensor(g)[0])
    density = random_values(*SHAPE, seed=seed)
    return Volume(box_grid(SHAPE), density, 0.1 * sigma_s, sigma_s, phase)


SMOKE, DUST = medium(1, tensor(3.0), 0.6), medium(2, tensor(1.0, 2.0, 4.0), -0.3)


def scene_of(volume):
    return replace(make_scene(volume.density, transport_rounds=1, ambient=(0.2,)), volume=volume)


def test_sections_and_mean_cosine_are_those_of_both_weighed_by_how_much_each_scatters():
    medium = scale_medium(mix_media({"smoke": SMOKE, "dust": DUST}))
    scattered = [one.sigma_s.view(-1, 1, 1, 1) * one.density for one in (SMOKE, DUST)]
    torch.testing.assert_close(medium.scattering.value, sum(scattered))
    torch.testing.assert_close(medium.absorption.value, 0.1 * sum(scattered))
    found, expected = medium.g * medium.scattering.value, 0.6 * scattered[0] - 0.3 * scattered[1]
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("volume, absent", [(SMOKE, DUST), (DUST, SMOKE)])
def test_beside_nothing_a_medium_is_as_it_is_alone(volume, absent):
    nothing = replace(absent, density=torch.zeros(SHAPE, dtype=torch.float64))
    images = [
        render(scene_of(mix_media(media)))
        for media in ({"volume": volume, "none": nothing}, {"none": nothing, "volume": volume})
    ]
    fields = (
        sigma.view(-1, 1, 1, 1) * volume.density for sigma in (volume.sigma_a, volume.sigma_s)
    )
    alone = Volume(volume.grid, torch.ones_like(volume.density), *fields, volume.phase)
    for image in images:
        torch.testing.assert_close(image, render(scene_of(alone)), rtol=2e-4, atol=1e-6)


def test_each_number_of_each_medium_is_a_variable():
    scene = scene_of(mix_media({"smoke": SMOKE, "air": replace(DUST, phase=Rayleigh(tensor(0)))}))
    names = [name for name in variable_names(scene) if name.startswith("media.")]
    assert "media.smoke.g" in names and "media.air.g" not in names and "density" not in names
    values = {name: 0.9 * value_of(scene, name) for name in ("media.smoke.g", "media.air.density")}
    changed = with_values(scene, values)
    for name, value in values.items():
        assert torch.equal(value_of(changed, name), value)
    media = changed.volume.media
    assert media is not None and torch.equal(media["air"].density, 0.9 * DUST.density)
    expected = mix_media(media)
    for name in ("sigma_a", "sigma_s"):
        assert torch.equal(getattr(changed.volume, name), getattr(expected, name))


def test_on_a_coarser_grid_each_medium_is_coarser():
    scene = scene_of(mix_media({"smoke": SMOKE, "dust": DUST}))
    coarse = scene_at_level(scene, 2).volume
    alone = scene_at_level(scene_of(SMOKE), 2).volume
    assert coarse.media is not None
    assert torch.equal(coarse.media["smoke"].density, alone.density)
    assert coarse.sigma_s.shape[1:] == coarse.grid.shape == alone.grid.shape


@pytest.mark.parametrize("glow", ["emission", "black_body"])
def test_what_a_mixture_has_itself_it_has_on_coarser_grids_and_with_other_values(glow):
    """Of what glows and scatters there is as much; it glows, and scatters, where its support is."""
    support, glows = (random_values(*SHAPE, seed=3) > 0.5).double(), {glow: tensor(0.2, 0.3, 0.5)}
    whole = replace(mix_media({"smoke": SMOKE, "dust": DUST}), support=support, index=1.4, **glows)
    scene, medium = scene_of(whole), scale_medium(whole)
    same = with_values(scene, {"media.dust.density": DUST.density}).volume
    for volume in (volume_at_level(whole, box_grid((2, 5, 3))), same):
        found = scale_medium(volume)
        assert found.index == 1.4 and found.emission is not None and medium.emission is not None
        for one, other in (
            (found.emission, medium.emission),
            (found.scattering.value, medium.scattering.value),
            (found.absorption.value, medium.absorption.value),
        ):
            means = (each.mean((1, 2, 3)).expand(3) for each in (one, other))
            torch.testing.assert_close(*means, rtol=1e-12, atol=0)


def test_where_both_are_empty_derivatives_are_finite():
    density = torch.zeros(SHAPE, dtype=torch.float64, requires_grad=True)
    media = {"smoke": replace(SMOKE, density=density), "dust": replace(DUST, density=density)}
    (bar,) = torch.autograd.grad(render(scene_of(mix_media(media))).sum(), density)
    assert bool(bar.isfinite().all()) and bool(bar.any())


def test_a_mixture_is_of_two_on_one_grid():
    with pytest.raises(ValueError, match="two media on the same grid"):
        mix_media({"smoke": SMOKE})
    for part in ({"emission": tensor(1)}, {"index": 1.4}):
        with pytest.raises(ValueError, match="not for a medium of it"):
            mix_media({"smoke": SMOKE, "dust": replace(DUST, **part)})


FLAT = 4, 1, 5
GRID = Grid(FLAT, (-0.4, -0.3, -0.5), (0.4, 0.3, 0.5))


@pytest.mark.parametrize(("times", "along"), [(3, "xyz"), (9, "xyz"), (3, "xy")])
def test_a_finer_medium_has_the_same_values_everywhere(times, along):
    """And is as empty beyond its support."""
    scene = make_scene(random_values(*FLAT), sigma_s=random_values(3, *FLAT, seed=1), grid=GRID)
    support = random_values(*FLAT, seed=3) > 0.5
    medium = scale_medium(replace(scene.volume, support=support))
    finer = refine_medium(medium, times, along)
    assert finer.grid.shape == (4 * times if "z" in along else 4, 1, 5 * times)
    points = (2 * random_values(1, 500, 3, seed=2) - 1).expand(1, -1, -1)
    for name in ("extinction", "scattering", "absorption"):
        fields = (getattr(item, name).field for item in (finer, medium))
        torch.testing.assert_close(*(sample_volume(field, points) for field in fields))


def test_a_finer_medium_that_repeats_has_no_seam():
    grid = replace(GRID, periodic=(2,))
    scene = make_scene(random_values(*FLAT), grid=grid)
    turned = make_scene(scene.volume.density.roll(2, 2), grid=grid)
    one, other = (refine_medium(scale_medium(each.volume), 3, "x") for each in (scene, turned))
    torch.testing.assert_close(other.extinction.field, one.extinction.field.roll(6, 3))


def test_fluence_in_finer_cells_is_that_of_cells_as_given():
    """Of even light without absorption it is 4 pi times that, in every cell."""
    options = {"directional": None, "ambient": (0.5,), "sigma_a": (0.0,), "refine": 3}
    scene = make_scene(random_values(*FLAT), grid=GRID, sigma_s=(9.0,), **options)
    actual = fluence(scene, SolveMemory())
    torch.testing.assert_close(actual, torch.full((1, *FLAT), 2 * torch.pi, dtype=torch.float64))
