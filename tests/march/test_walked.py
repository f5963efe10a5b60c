"""Outside of a volume's support nothing is walked, and inside nothing else changes (E10.4)."""

from dataclasses import replace
from typing import Any

import pytest
import torch
import torch.autograd.forward_ad as forward
from media import (
    half_empty,
    image_gradients,
    make_camera,
    make_scene,
    random_values,
    weights_of,
)
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import use_engine
from ddrecon.march.samplers import planes_across, support_of_planes
from ddrecon.march.sight import look_through
from ddrecon.picture import render
from ddrecon.scene import Scene
from ddrecon.settings import RenderSettings
from ddrecon.variables.values import value_of, with_values

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


def tangent(scene: Scene, name: str, change: Tensor) -> Tensor:
    with forward.dual_level():
        dual = forward.make_dual(value_of(scene, name).detach(), change)
        changed = with_values(scene, {name: dual})
        return forward.unpack_dual(render(changed, memory=SolveMemory())).tangent


ENGINES = ["torch", pytest.param("warp", marks=pytest.mark.slow)]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("settings", [{}, TWO_STEPS, LATTICE], ids=str)
@pytest.mark.parametrize("names", [PACKETS, RAYS], ids=["packets", "rays"])
def test_images_and_derivatives_are_those_without_it(engine: str, settings: dict, names: list[str]):
    """But for those by the density outside, which are 0."""
    use_engine(engine)
    support, size = two_blobs(), (30, 31) if settings == LATTICE else (9, 10)
    (known, (of_all, of_other)), (image, (of_density, of_same)) = (
        image_gradients(scene_with(given, settings, names is RAYS, size=size), names)
        for given in (None, support)
    )
    assert bool((of_all * (1 - support)).any())
    torch.testing.assert_close(image, known, rtol=1e-13, atol=0)
    torch.testing.assert_close(of_density, of_all * support, rtol=1e-10, atol=1e-13)
    torch.testing.assert_close(of_same, of_other, rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize("engine", ENGINES)
def test_tangent_and_adjoint_are_transposes_where_density_may_be(engine: str):
    """<J v, w> = <v, J^T w>, and J v knows nothing of v outside."""
    use_engine(engine)
    support, change = two_blobs(), random_values(*SHAPE, seed=5)
    scene = scene_with(support, {})
    along = tangent(scene, "density", change)
    assert torch.equal(along, tangent(scene, "density", change * support))
    known = tangent(scene_with(None, {}), "density", change * support)
    torch.testing.assert_close(along, known, rtol=1e-9, atol=1e-13)
    gradient = image_gradients(scene, ["density"])[1][0]
    weights = weights_of(along)
    assert float((along * weights).sum()) == pytest.approx(float((gradient * change).sum()), 1e-9)
    pose = value_of(scene, "views.view.camera").detach()
    turn = random_values(*pose.shape, seed=6).to(pose)
    found, expected = (
        tangent(scene_with(given, {}, is_gray=True), "views.view.camera", turn)
        for given in (support, None)
    )
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-13)


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
