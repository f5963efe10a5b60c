"""Coarse to fine: what resampling keeps, and which stage an iteration belongs to."""

from dataclasses import replace

import torch

from ddrecon.cameras import Camera, cast_rays
from ddrecon.grid import Grid
from ddrecon.reconstruct.levels import factors, resample, scene_at_level, stage_of


def test_coarsening_keeps_the_mass(ball_scene) -> None:
    density = torch.rand(ball_scene.volume.grid.shape, dtype=torch.float64)
    coarse = resample(density, ball_scene.volume.grid.coarsen(2))
    assert torch.isclose(coarse.mean(), density.mean(), rtol=1e-12)


def test_refining_keeps_constants_and_linear_fields_inside() -> None:
    fine = Grid((8, 8, 8), (0.0,) * 3, (1.0,) * 3)
    coarse = fine.coarsen(2)
    z = coarse.centers(torch.zeros(1, dtype=torch.float64))[0].expand(*coarse.shape)
    refined = resample(z, fine)
    expected = fine.centers(torch.zeros(1, dtype=torch.float64))[0].expand(*fine.shape)
    assert torch.allclose(refined[1:-1], expected[1:-1], atol=1e-12)


def test_targets_are_averaged_over_the_larger_pixels(ball_scene) -> None:
    coarse = scene_at_level(ball_scene, 2)
    for fine_view, view in zip(ball_scene.views, coarse.views, strict=True):
        assert torch.allclose(view.image.mean(), fine_view.image.mean(), rtol=1e-5)
        assert tuple(view.image.shape[1:]) == view.camera.size


def test_a_coarser_camera_sees_the_same_frame(ball_scene) -> None:
    camera: Camera = ball_scene.views[0].camera
    corners = (
        cast_rays(camera, (0.0, 0.0)).direction[0],
        cast_rays(camera.resize(2), (0.0, 0.0)).direction[0],
    )
    assert torch.allclose(*corners, atol=1e-6)


def test_what_a_coarser_scene_starts_from_is_coarser_too(ball_scene) -> None:
    fine = ball_scene.volume.density
    starts = {"density": fine, "sigma_a": torch.tensor([1.0, 2.0, 3.0])}
    coarse = scene_at_level(replace(ball_scene, starts=starts), 2)
    assert torch.equal(coarse.starts["density"], coarse.volume.density)
    assert torch.equal(coarse.starts["sigma_a"], starts["sigma_a"])


def test_stages_follow_the_fractions() -> None:
    assert [stage_of(i, 10, (0.3, 0.6)) for i in range(10)] == [0, 0, 0, 1, 1, 1, 2, 2, 2, 2]


def test_small_grids_are_not_coarsened_away(ball_scene) -> None:
    assert factors(ball_scene, (0.3, 0.6)) == [2, 2, 1]
