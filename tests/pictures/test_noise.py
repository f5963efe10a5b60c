"""Noise: what is put into a picture is found in it, and nothing else."""

import pytest
import torch

from ddrecon.pictures.noise import LEAST, Noise, estimate_noise
from ddrecon.pictures.srgb import display, display_slope


def smooth_picture(size: int = 160) -> torch.Tensor:
    """A picture with everything between black and 1, whose second differences are nearly 0."""
    place = torch.linspace(0, 1, size, dtype=torch.float64)
    return torch.stack([(place[:, None] * place.roll(0)) ** power for power in (1.0, 1.5, 2.0)])


@pytest.mark.parametrize(("read", "shot"), [(0.02, 0.0), (0.005, 2e-3), (0.0, 1e-3)])
def test_the_noise_of_a_picture_is_found(read: float, shot: float) -> None:
    picture, generator = smooth_picture(), torch.Generator().manual_seed(1)
    random = torch.randn(picture.shape, generator=generator, dtype=torch.float64)
    found = estimate_noise(picture + Noise(read, shot).deviation(picture) * random, 0.0)
    for value in (0.05, 0.3, 0.9):
        at = torch.tensor(value, dtype=torch.float64)
        wanted = float(Noise(read, shot).deviation(at))
        assert float(found.deviation(at)) == pytest.approx(wanted, rel=0.15)


def test_a_smooth_picture_errs_by_the_least_that_is_assumed() -> None:
    picture = smooth_picture()
    found = estimate_noise(picture, 0.0)
    least = LEAST * float(picture.square().mean().sqrt())
    assert found.read == pytest.approx(least, rel=0.5) and found.shot < 1e-6


def test_quantization_is_that_of_rounded_values() -> None:
    values = torch.linspace(0.01, 0.9, 200_001, dtype=torch.float64)
    step = 1 / 255
    shown = display(values)
    error = ((shown / step).round() * step - shown) / display_slope(values)
    deviation = Noise(0.0, 0.0, step).deviation(values)
    for part, wanted in zip(error.chunk(5), deviation.chunk(5), strict=True):
        assert float(part.square().mean().sqrt()) == pytest.approx(
            float(wanted.square().mean().sqrt()), rel=0.05
        )


def test_a_picture_too_small_to_tell_has_read_noise_only() -> None:
    assert estimate_noise(torch.rand(3, 2, 9), 0.0).shot == 0


def test_means_of_pixels_err_by_the_root_of_their_count_less() -> None:
    noise, values = Noise(0.02, 1e-3, 1 / 255), torch.linspace(0, 1, 9)
    expected = noise.deviation(values) / 3
    torch.testing.assert_close(noise.averaged(9).deviation(values), expected)
