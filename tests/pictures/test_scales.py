"""Scales: closed forms, and slopes that are derivatives."""

import numpy as np
import pytest
import torch

from ddrecon.pictures import srgb
from ddrecon.pictures.noise import Noise
from ddrecon.pictures.scales import Stabilized
from ddrecon.pictures.srgb import display, display_slope


def test_display_is_the_curve_that_files_are_written_by() -> None:
    values = np.linspace(0, 1, 1001)
    torch.testing.assert_close(
        display(torch.from_numpy(values)), torch.from_numpy(srgb.encode(values))
    )
    assert display(torch.tensor([-1.0, 2.0])).tolist() == pytest.approx([0, 1])


def test_the_slope_of_display_is_its_derivative() -> None:
    values = torch.linspace(1e-4, 0.999, 400, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(display(values).sum(), values)
    torch.testing.assert_close(display_slope(values.detach()), slope)


def test_without_quantization_radiance_is_stabilized_by_a_square_root() -> None:
    read, shot = 0.01, 0.002
    values = torch.linspace(0, 1.3, 500, dtype=torch.float64)
    wanted = (2 / shot) * ((read**2 + shot * values).sqrt() - read)
    found = Stabilized(noise=Noise(read, shot)).values(values)
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("step", [0.0, 1 / 255])
def test_a_flat_picture_has_the_slope_of_its_scale(step: float) -> None:
    scale, level, change = Stabilized(noise=Noise(0.001, 1e-3, step)), 0.3, 1e-3
    flat = torch.full((3, 7, 8), level, dtype=torch.float64)
    places = torch.tensor([level - change, level + change, 1.0], dtype=torch.float64)
    low, high, _ = scale.values(places)
    torch.testing.assert_close(
        scale.slope(flat),
        torch.full_like(flat, float(high - low) / (2 * change)),
        rtol=1e-2,
        atol=0,
    )
