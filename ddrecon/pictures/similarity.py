"""Structural similarity: how alike two images are in mean, contrast and structure."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

RADIUS, DEVIATION = 5, 1.5
"""The Gaussian window, in pixels: 11 x 11."""
K1, K2 = 0.01, 0.03
"""Parts of the peak that keep quotients finite in flat places."""


def structural_similarity(
    image: Tensor, reference: Tensor, peak: Tensor, seen: Tensor | None = None
) -> Tensor:
    """The structural similarity [c, h, w] of two images [c, h, w] whose largest value is `peak`.

    Wang et al. 2004, doi:10.1109/TIP.2003.819861, with their window. At an edge it is cut off, and
    where `seen` [h, w] is 0.
    """
    place = torch.arange(-RADIUS, RADIUS + 1).to(image)
    window = torch.exp(-0.5 * (place / DEVIATION) ** 2)

    def blur(values: Tensor) -> Tensor:
        padded = pad(values[:, None], (RADIUS,) * 4)
        return conv2d(conv2d(padded, window.view(1, 1, -1, 1)), window.view(1, 1, 1, -1))[:, 0]

    seen = torch.ones_like(image[0]) if seen is None else seen
    weight = blur(seen[None]).clamp(min=torch.finfo(seen.dtype).tiny)

    def mean(values: Tensor) -> Tensor:
        return blur(values * seen) / weight

    first, second = mean(image), mean(reference)
    contrast = mean(image * image) - first**2 + mean(reference * reference) - second**2
    structure = mean(image * reference) - first * second
    low, high = (K1 * peak) ** 2, (K2 * peak) ** 2
    return ((2 * first * second + low) * (2 * structure + high)) / (
        (first**2 + second**2 + low) * (contrast + high)
    )
