"""Noise that is put into a picture is found in it; scales and similarity have closed forms."""

import math

import pytest
import torch

from ddrecon.pictures import (
    DEVIATION,
    K1,
    K2,
    LEAST,
    RADIUS,
    Noise,
    Stabilized,
    display,
    display_slope,
    estimate_noise,
    structural_similarity,
)


def smooth_picture(size=160):
    """A picture with everything between black and 1, whose second differences are nearly 0."""
    place = torch.linspace(0, 1, size, dtype=torch.float64)
    return torch.stack([(place[:, None] * place.roll(0)) ** power for power in (1.0, 1.5, 2.0)])


@pytest.mark.parametrize(("read", "shot"), [(0.02, 0.0), (0.005, 2e-3), (0.0, 1e-3)])
def test_the_noise_of_a_picture_is_found(read, shot):
    picture, generator = smooth_picture(), torch.Generator().manual_seed(1)
    random = torch.randn(picture.shape, generator=generator, dtype=torch.float64)
    found = estimate_noise(picture + Noise(read, shot).deviation(picture) * random, 0.0)
    for value in (0.05, 0.3, 0.9):
        at = torch.tensor(value, dtype=torch.float64)
        wanted = float(Noise(read, shot).deviation(at))
        assert float(found.deviation(at)) == pytest.approx(wanted, rel=0.15)


def test_a_smooth_picture_errs_by_the_least_that_is_assumed():
    picture = smooth_picture()
    found = estimate_noise(picture, 0.0)
    least = LEAST * float(picture.square().mean().sqrt())
    assert found.read == pytest.approx(least, rel=0.5) and found.shot < 1e-6


def test_quantization_is_that_of_rounded_values():
    values = torch.linspace(0.01, 0.9, 200_001, dtype=torch.float64)
    step = 1 / 255
    shown = display(values)
    error = ((shown / step).round() * step - shown) / display_slope(values)
    deviation = Noise(0.0, 0.0, step).deviation(values)
    for part, wanted in zip(error.chunk(5), deviation.chunk(5), strict=True):
        assert float(part.square().mean().sqrt()) == pytest.approx(
            float(wanted.square().mean().sqrt()), rel=0.05
        )


def test_a_picture_too_small_to_tell_has_read_noise_only():
    assert estimate_noise(torch.rand(3, 2, 9), 0.0).shot == 0


def test_the_slope_of_display_is_its_derivative():
    values = torch.linspace(1e-4, 0.999, 400, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(display(values).sum(), values)
    torch.testing.assert_close(display_slope(values.detach()), slope)


def test_without_quantization_radiance_is_stabilized_by_a_square_root():
    read, shot = 0.01, 0.002
    values = torch.linspace(0, 1.3, 500, dtype=torch.float64)
    wanted = (2 / shot) * ((read**2 + shot * values).sqrt() - read)
    found = Stabilized(noise=Noise(read, shot)).values(values)
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("step", [0.0, 1 / 255])
def test_a_flat_picture_has_the_slope_of_its_scale(step):
    scale, level, change = Stabilized(noise=Noise(0.001, 1e-3, step)), 0.3, 1e-3
    flat = torch.full((3, 7, 8), level, dtype=torch.float64)
    places = torch.tensor([level - change, level + change, 1.0], dtype=torch.float64)
    low, high, _ = scale.values(places)
    expected = torch.full_like(flat, float(high - low) / (2 * change))
    torch.testing.assert_close(scale.slope(flat), expected, rtol=1e-2, atol=0)


PEAK = torch.tensor(1.0, dtype=torch.float64)


def test_flat_images_differ_in_their_means_only():
    one, other = (torch.full((1, 12, 12), value, dtype=torch.float64) for value in (0.3, 0.6))
    wanted = (2 * 0.18 + K1**2) / (0.09 + 0.36 + K1**2)
    torch.testing.assert_close(
        structural_similarity(one, other, PEAK), torch.full_like(one, wanted)
    )


def test_a_pixel_is_what_its_definition_says():
    image, other = torch.rand(2, 1, 16, 13, dtype=torch.float64).unbind()
    row, column = 2, 11  # near two edges
    weights, pairs = [], []
    for i in range(max(0, row - RADIUS), min(16, row + RADIUS + 1)):
        for j in range(max(0, column - RADIUS), min(13, column + RADIUS + 1)):
            square = (i - row) ** 2 + (j - column) ** 2
            weights.append(math.exp(-square / (2 * DEVIATION**2)))
            pairs.append((float(image[0, i, j]), float(other[0, i, j])))

    def mean(values):
        return sum(w * v for w, v in zip(weights, values, strict=True)) / sum(weights)

    a, b = mean([x for x, _ in pairs]), mean([y for _, y in pairs])
    variances = mean([x * x for x, _ in pairs]) - a * a + mean([y * y for _, y in pairs]) - b * b
    together = mean([x * y for x, y in pairs]) - a * b
    wanted = (2 * a * b + K1**2) * (2 * together + K2**2)
    wanted /= (a * a + b * b + K1**2) * (variances + K2**2)
    found = structural_similarity(image, other, PEAK)
    assert float(found[0, row, column]) == pytest.approx(wanted, rel=1e-10)
