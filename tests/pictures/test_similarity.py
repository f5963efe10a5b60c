"""Structural similarity: closed forms, and its definition pixel by pixel."""

import math

import pytest
import torch

from ddrecon.pictures.similarity import DEVIATION, K1, K2, RADIUS, structural_similarity

PEAK = torch.tensor(1.0, dtype=torch.float64)


def test_an_image_is_like_itself() -> None:
    image = torch.rand(3, 9, 14, dtype=torch.float64)
    torch.testing.assert_close(structural_similarity(image, image, PEAK), torch.ones_like(image))


def test_flat_images_differ_in_their_means_only() -> None:
    one, other = (torch.full((1, 12, 12), value, dtype=torch.float64) for value in (0.3, 0.6))
    wanted = (2 * 0.18 + K1**2) / (0.09 + 0.36 + K1**2)
    torch.testing.assert_close(
        structural_similarity(one, other, PEAK), torch.full_like(one, wanted)
    )


def test_a_pixel_is_what_its_definition_says() -> None:
    image, other = torch.rand(2, 1, 16, 13, dtype=torch.float64).unbind()
    row, column = 2, 11  # near two edges
    weights, pairs = [], []
    for i in range(max(0, row - RADIUS), min(16, row + RADIUS + 1)):
        for j in range(max(0, column - RADIUS), min(13, column + RADIUS + 1)):
            square = (i - row) ** 2 + (j - column) ** 2
            weights.append(math.exp(-square / (2 * DEVIATION**2)))
            pairs.append((float(image[0, i, j]), float(other[0, i, j])))

    def mean(values: list[float]) -> float:
        return sum(w * v for w, v in zip(weights, values, strict=True)) / sum(weights)

    a, b = mean([x for x, _ in pairs]), mean([y for _, y in pairs])
    variances = mean([x * x for x, _ in pairs]) - a * a + mean([y * y for _, y in pairs]) - b * b
    together = mean([x * y for x, y in pairs]) - a * b
    wanted = (2 * a * b + K1**2) * (2 * together + K2**2)
    wanted /= (a * a + b * b + K1**2) * (variances + K2**2)
    found = structural_similarity(image, other, PEAK)
    assert float(found[0, row, column]) == pytest.approx(wanted, rel=1e-10)
