"""Losses: closed forms, masks, and invariances of total variation."""

import pytest
import torch

from ddrecon.grid import Grid
from ddrecon.reconstruct.losses import image_loss, psnr, total_variation


def box(cells: int, side: float = 1.0) -> Grid:
    return Grid((cells,) * 3, (0.0,) * 3, (side,) * 3)


def test_l2_is_the_mean_square() -> None:
    image, target = torch.rand(3, 4, 5), torch.rand(3, 4, 5)
    assert image_loss("l2", image, target, None) == pytest.approx(float(((image - target) ** 2).sum()) / 60)


def test_masked_pixels_do_not_count() -> None:
    image, target, mask = torch.rand(3, 4, 5), torch.rand(3, 4, 5), (torch.rand(4, 5) > 0.5).float()
    spoiled = torch.where(mask > 0, target, target + 100)
    assert image_loss("l2", image, spoiled, mask) == image_loss("l2", image, target, mask)
    kept = mask.bool()
    assert float(image_loss("l2", image, target, mask)) == pytest.approx(float(((image - target)[:, kept] ** 2).mean()), rel=1e-6)


def test_psnr_of_a_known_error() -> None:
    target = torch.ones(3, 8, 8)
    assert psnr(target + 0.01, target, None) == pytest.approx(40, abs=1e-3)


@pytest.mark.parametrize("cells", [8, 16, 32])
def test_total_variation_of_a_ramp_is_its_slope_at_any_resolution(cells: int) -> None:
    grid = box(cells)
    ramp = 2 * grid.centers(torch.zeros(1, dtype=torch.float64))[2].expand(*grid.shape)
    inner = (cells - 1) / cells
    assert float(total_variation(ramp, grid)) == pytest.approx(2 * inner, rel=0.01)


def test_total_variation_does_not_depend_on_world_scale() -> None:
    field = torch.rand(6, 6, 6, dtype=torch.float64)
    assert float(total_variation(field, box(6))) == pytest.approx(float(total_variation(field, box(6, 7.0))), rel=1e-12)


def test_total_variation_has_a_finite_derivative_where_flat() -> None:
    field = torch.zeros(4, 4, 4, requires_grad=True)
    total_variation(field, box(4)).backward()
    assert torch.isfinite(field.grad).all()
