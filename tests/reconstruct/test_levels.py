"""Coarse to fine: what resampling keeps, and how coarse a run begins."""

from dataclasses import replace

import pytest
import torch

from ddrecon.cameras import CELL, cell_width
from ddrecon.grid import Grid
from ddrecon.medium.coefficients import resample
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.frame import Frame
from ddrecon.reconstruct.setup import factors, scene_at_level
from ddrecon.settings import NoiseSettings


def test_coarsening_keeps_the_mass(ball_scene):
    density = torch.rand(ball_scene.volume.grid.shape, dtype=torch.float64)
    coarse = resample(density, ball_scene.volume.grid.coarsen(2))
    assert torch.isclose(coarse.mean(), density.mean(), rtol=1e-12)


def test_refining_keeps_constants_and_linear_fields_inside():
    fine = Grid((8, 8, 8), (0.0,) * 3, (1.0,) * 3)
    coarse = fine.coarsen(2)
    z = coarse.centers(torch.zeros(1, dtype=torch.float64))[0].expand(*coarse.shape)
    refined = resample(z, fine)
    expected = fine.centers(torch.zeros(1, dtype=torch.float64))[0].expand(*fine.shape)
    assert torch.allclose(refined[1:-1], expected[1:-1], atol=1e-12)


def test_targets_are_averaged_over_the_larger_pixels(ball_scene):
    coarse = scene_at_level(ball_scene, 2)
    for fine_view, view in zip(ball_scene.views, coarse.views, strict=True):
        assert torch.allclose(view.image.mean(), fine_view.image.mean(), rtol=1e-5)
        assert tuple(view.image.shape[1:]) == view.camera.size


@pytest.mark.parametrize("times", [1, 6, 24])
def test_pixels_are_averaged_where_cells_are_many_of_them_wide(ball_scene, times):
    """A photograph of ten million pixels shows a grid of 32^3 cells no better than a small one."""
    view, grid = ball_scene.views[0], ball_scene.volume.grid
    image = view.image.repeat_interleave(times, 1).repeat_interleave(times, 2)
    large = replace(view, image=image, camera=replace(view.camera, size=tuple(image.shape[1:])))
    (averaged,) = scene_at_level(replace(ball_scene, views=[large]), 1).views
    before, after = (cell_width(grid, v.camera) for v in (large, averaged))
    assert averaged.image.shape[1:] == averaged.camera.size
    assert averaged is large if before < 2 * CELL else CELL <= after < 3.5
    assert torch.allclose(averaged.image.mean(), view.image.mean(), rtol=1e-3)


def test_pixels_that_do_not_count_are_in_no_average(ball_scene):
    """They may hold any number; those beside them keep theirs."""
    view = ball_scene.views[0]
    mask = (torch.rand(view.camera.size, generator=torch.manual_seed(0)) > 0.3).float()
    image = torch.full((3, *mask.shape), 0.25).where(mask > 0, 1000.0)
    masked = replace(view, image=image, mask=mask)
    (averaged,) = scene_at_level(replace(ball_scene, views=[masked]), 2).views
    assert averaged.image.shape[1] < mask.shape[0] and averaged.mask.mean() > 0.5
    assert torch.allclose(averaged.image[:, averaged.mask > 0], torch.tensor(0.25))


def test_noise_of_averaged_pictures_is_less(ball_scene):
    """The loss that given noise explains is that of pictures with such noise, at each level."""
    view = ball_scene.views[0]
    settings = replace(ball_scene.optimize, noise=NoiseSettings(read=0.03))
    black = replace(view, image=torch.zeros(3, 96, 96), mask=None)
    black = replace(black, camera=replace(view.camera, size=(96, 96)))
    noisy = replace(black, image=0.03 * torch.randn(3, 96, 96, generator=torch.manual_seed(0)))
    frame = Frame(replace(ball_scene, views=[noisy], optimize=settings), None)
    for level in range(len(frame.problem.factors)):
        frame.enter(level)
        (shown,) = frame.level.train.views
        loss = float(shown.image.square().mean()) / frame.problem.unit
        assert frame.noise_loss() == pytest.approx(loss, rel=0.1)


def test_what_a_coarser_scene_starts_from_is_coarser_too(ball_scene):
    fine = ball_scene.volume.density
    starts = {"density": fine, "sigma_a": torch.tensor([1.0, 2.0, 3.0])}
    coarse = scene_at_level(replace(ball_scene, starts=starts), 2)
    assert torch.equal(coarse.starts["density"], coarse.volume.density)
    assert torch.equal(coarse.starts["sigma_a"], starts["sigma_a"])


@pytest.mark.parametrize(("side", "wanted"), [(31, [1]), (32, [2, 1]), (64, [4, 2, 1])])
def test_small_grids_are_not_coarsened_away(ball_scene, side, wanted):
    """The shortest side keeps `FEWEST_CELLS`."""
    assert tuning.FEWEST_CELLS == 16
    grid = replace(ball_scene.volume.grid, shape=(96, side, 80))
    volume = replace(ball_scene.volume, grid=grid)
    assert factors(replace(ball_scene, volume=volume)) == wanted
