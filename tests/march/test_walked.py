"""Outside of a volume's support nothing is walked, and inside nothing else changes (E10.4)."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from media import half_empty, make_camera, make_scene
from torch import Tensor
from twins import Tensors, assert_same, assert_transposes, differentiate, images_of, values_of

from ddrecon.march.samplers import planes_across, support_of_planes
from ddrecon.march.sight import look_through
from ddrecon.picture import render
from ddrecon.scene import Scene
from ddrecon.settings import RenderSettings
from ddrecon.variables.values import with_values

SHAPE = (7, 9, 8)
PACKETS, RAYS = ["density", "g"], ["density", "views.view.camera"]
TWO_STEPS, LATTICE = {"steps_per_voxel": 2}, {"tolerance": 0.05}


def two_blobs() -> Tensor:
    """A support that rays enter twice, or once, or not at all."""
    support = torch.zeros(SHAPE, dtype=torch.float64)
    support[0:2, 2:5, 2:6] = 1
    support[5:6, 3:6, 1:4] = 1
    return support


def scene_with(support: Tensor | None, settings: dict, is_gray: bool = False, **view: Any) -> Scene:
    """A scene of which density lies in `two_blobs`, whether it is told so or not."""
    camera = make_camera(**({"size": (9, 10), "half_width": 0.4} | view))
    density = half_empty(*SHAPE) * two_blobs()
    medium = {"sigma_a": (1.0,), "sigma_s": (6.0,)} if is_gray else {"g": 0.5}
    scene = make_scene(density, ambient=(0.3,), camera=camera, **medium)
    scene.volume = replace(scene.volume, support=support)
    scene.render = replace(RenderSettings(**settings), background=True)
    return scene


ENGINES = ["torch", pytest.param("warp", marks=pytest.mark.slow)]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("settings", [{}, TWO_STEPS, LATTICE], ids=str)
@pytest.mark.parametrize("names", [PACKETS, RAYS], ids=["packets", "rays"])
def test_images_and_derivatives_are_those_without_it(engine: str, settings: dict, names: list[str]):
    """But for those by the density outside, which are 0, and changes of which nobody sees."""
    support, size = two_blobs(), (30, 31) if settings == LATTICE else (9, 10)
    without, within = (
        scene_with(given, settings, names is RAYS, size=size) for given in (None, support)
    )
    values = values_of(within, names)
    found = differentiate(engine, images_of(within), values, has_tangent=True)
    assert_transposes(found, values)

    def show(values: Tensors) -> list[Tensor]:
        """Without a support, of which the density outside varies as little as with it."""
        density = values["density"] * support + (values["density"] * (1 - support)).detach()
        return images_of(without)(values | {"density": density})

    assert_same(found, differentiate(engine, show, values, has_tangent=True), 1e-11)
    outside = differentiate(engine, images_of(without), values)["by density"] * (1 - support)
    assert bool(outside.any())


def test_rays_that_miss_it_show_what_is_behind():
    """Exactly, and what they show does not change with any cell."""
    scene = scene_with(two_blobs(), {}, half_width=0.9)
    image = render(scene)
    is_behind = (image == 0.3).all(1)
    assert bool(is_behind.any()) and not bool(is_behind.all())
    changed = with_values(scene, {"density": scene.volume.density + 1})
    assert torch.equal((render(changed) == 0.3).all(1), is_behind)


@pytest.mark.slow
def test_what_it_leaves_out_is_not_walked():
    """By bits: none of no support, and of blobs less than half of what all cells have."""
    pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
    from ddrecon.march.fused.bundle import pack_rays
    from ddrecon.march.fused.cells import find_walked

    scene = scene_with(two_blobs(), {}, half_width=0.6)
    grid = scene.volume.grid
    sight = look_through(scene.views[0].camera, grid, scene.render)
    planes = planes_across(grid, sight.sampling, 1, torch.float64, torch.device("cpu"))
    rays, ends = sight.rays, vars(sight.crossing).values()
    bundle = pack_rays(grid, sight.sampling.axis, rays.origin, rays.direction, *ends).bundle

    def count(support: Tensor) -> int:
        bits = find_walked(support_of_planes(support, sight.sampling, 1), planes, bundle)
        return sum(number.bit_count() for number in bits.flatten().tolist())

    none, some, all_of_them = map(count, (torch.zeros(SHAPE), two_blobs(), torch.ones(SHAPE)))
    assert none == 0 < some < all_of_them / 2
