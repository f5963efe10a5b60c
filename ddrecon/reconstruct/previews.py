"""Pictures of a run: targets beside renders beside differences, and slices of the volume. Arrays here are numpy, [h, w, 3]."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from ddrecon.io.srgb import decode

ENLARGED = 4
"""Differences are shown this many times enlarged, around mid-gray."""
BLUE, RED = (0.13, 0.30, 0.70), (0.70, 0.09, 0.13)
"""Ends of the diverging scale, as sRGB values."""
GAP = 4
"""Pixels between pictures."""


def pixels(image: Tensor) -> np.ndarray:
    """`image` [3, h, w] as float32 [h, w, 3]."""
    array: np.ndarray = image.detach().permute(1, 2, 0).float().cpu().numpy()
    return array


def comparison(target: Tensor, image: Tensor) -> np.ndarray:
    """Target, render and enlarged difference side by side; brightness scaled so that the target's brightest pixels are just white."""
    wanted, got = pixels(target), pixels(image)
    white = max(float(np.quantile(wanted.max(-1), 0.999)), 1e-6)
    difference = np.clip(0.5 + ENLARGED * (got - wanted) / (2 * white), 0, 1) ** 2.2
    return beside([wanted / white, got / white, difference])


def slices(field: Tensor) -> np.ndarray:
    """The middle slices of `field` [z, y, x] or [C, z, y, x] across z, x and y, with y (or z) upwards; the largest value is white."""
    colors = field if field.ndim == 4 else field[None]
    array = colors.detach().expand(3, -1, -1, -1).permute(1, 2, 3, 0).float().cpu().numpy()
    z, y, x = (size // 2 for size in array.shape[:3])
    white = max(float(np.quantile(array, 0.999)), 1e-6)
    views = [array[z, ::-1, :], array[:, ::-1, x].transpose(1, 0, 2), array[::-1, y, :]]
    return beside([view / white for view in views])


def diverging(image: Tensor) -> tuple[np.ndarray, float]:
    """Signed `image` [3, h, w], averaged over colors, in blue (negative), white (zero) and red; and the value of full red."""
    values = pixels(image).mean(-1)
    full = max(float(np.quantile(np.abs(values), 0.999)), float(np.finfo(np.float32).tiny))
    part = np.clip(values / full, -1, 1)[..., None]
    strong = np.where(part < 0, np.array(BLUE, np.float32), np.array(RED, np.float32))
    return decode((1 - np.abs(part)) + np.abs(part) * strong), full


def beside(pictures: list[np.ndarray]) -> np.ndarray:
    """`pictures` in a row, top-aligned, on gray."""
    height = max(picture.shape[0] for picture in pictures)
    row = []
    for picture in pictures:
        frame = np.full((height, picture.shape[1] + GAP, 3), 0.2, np.float32)
        frame[: picture.shape[0], : picture.shape[1]] = picture
        row.append(frame)
    return np.concatenate(row, axis=1)[:, :-GAP]
