"""Pictures of a run: targets beside renders beside differences, and slices of the volume. Arrays
here are numpy, [h, w, 3].
"""

from __future__ import annotations

import numpy as np
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ddrecon.io.images.srgb import decode

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


def find_white(image: np.ndarray) -> float:
    """The radiance that is shown as white: that of the brightest pixels of `image` [h, w, 3], but
    for one in a thousand.
    """
    return max(float(np.quantile(image.max(-1), 0.999)), 1e-6)


def comparison(target: Tensor, image: Tensor) -> np.ndarray:
    """Target, render and enlarged difference side by side; brightness scaled so that the target's
    brightest pixels are just white.
    """
    wanted, got = pixels(target), pixels(image)
    white = find_white(wanted)
    difference = np.clip(0.5 + ENLARGED * (got - wanted) / (2 * white), 0, 1) ** 2.2
    return place_beside([wanted / white, got / white, difference])


def slices(field: Tensor) -> np.ndarray:
    """The middle slices of `field` [z, y, x] or [C, z, y, x] across z, x and y, with y (or z)
    upwards; the largest value is white.
    """
    array = _cells_of(field)
    z, y, x = (size // 2 for size in array.shape[:3])
    return _three_sides(
        [array[z], array[:, :, x], array[:, y]], max(float(np.quantile(array, 0.999)), 1e-6)
    )


def projections(field: Tensor) -> np.ndarray:
    """The means of `field` along z, x and y, placed as `slices` are; the largest mean is white."""
    array = _cells_of(field)
    means = [array.mean(axis) for axis in (0, 2, 1)]
    return _three_sides(means, max(*(float(side.max()) for side in means), 1e-6))


def _cells_of(field: Tensor) -> np.ndarray:
    """`field` as float32 [z, y, x, 3]."""
    colors = field if field.ndim == 4 else field[None]
    array: np.ndarray = (
        colors.detach().expand(3, -1, -1, -1).permute(1, 2, 3, 0).float().cpu().numpy()
    )
    return array


def _three_sides(sides: list[np.ndarray], white: float) -> np.ndarray:
    """Sides [y, x], [z, y] and [z, x], each with colors, as pictures in a row: y to the top, or z
    where there is no y.
    """
    across_z, across_x, across_y = (side / white for side in sides)
    return place_beside([across_z[::-1], across_x[:, ::-1].transpose(1, 0, 2), across_y[::-1]])


def shrink(image: Tensor, most: int) -> Tensor:
    """`image` [3, h, w] with so many fewer pixels, means of squares of them, that neither side has
    more than `most`.
    """
    factor = -(-max(image.shape[1:]) // most)
    return image if factor == 1 else avg_pool2d(image, factor, ceil_mode=True)


def diverging(image: Tensor) -> tuple[np.ndarray, float]:
    """Signed `image` [3, h, w], averaged over colors, in blue (negative), white (zero) and red; and
    the value of full red.
    """
    values = pixels(image).mean(-1)
    full = max(float(np.quantile(np.abs(values), 0.999)), float(np.finfo(np.float32).tiny))
    part = np.clip(values / full, -1, 1)[..., None]
    strong = np.where(part < 0, np.array(BLUE, np.float32), np.array(RED, np.float32))
    return decode((1 - np.abs(part)) + np.abs(part) * strong), full


def place_beside(pictures: list[np.ndarray]) -> np.ndarray:
    """`pictures` in a row, top-aligned, on gray."""
    height = max(picture.shape[0] for picture in pictures)
    row = []
    for picture in pictures:
        frame = np.full((height, picture.shape[1] + GAP, 3), 0.2, np.float32)
        frame[: picture.shape[0], : picture.shape[1]] = picture
        row.append(frame)
    return np.concatenate(row, axis=1)[:, :-GAP]
