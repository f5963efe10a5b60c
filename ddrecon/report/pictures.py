"""Pictures of a run: targets, renders and differences side by side, and slices of volumes.

Arrays here are numpy, [h, w, 3].
"""

import numpy as np
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ddrecon.pictures import decode

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


def find_high(values: np.ndarray) -> float:
    """What all but one of a thousand `values` are below; always above 0."""
    return max(float(np.quantile(values, 0.999)), 1e-6)


def find_white(image: np.ndarray) -> float:
    """The radiance that is shown as white in `image` [h, w, 3]: `find_high` of its pixels."""
    return find_high(image.max(-1))


def comparison(target: Tensor, image: Tensor) -> np.ndarray:
    """Target, render and enlarged difference side by side.

    Brightness is scaled so that the target's brightest pixels are just white.
    """
    expected, rendered = pixels(target), pixels(image)
    white = find_white(expected)
    # Previews encode by a gamma of about 2.2, so that no difference is mid-gray.
    difference = np.clip(0.5 + ENLARGED * (rendered - expected) / (2 * white), 0, 1) ** 2.2
    return place_beside([expected / white, rendered / white, difference])


def slices(field: Tensor) -> np.ndarray:
    """The middle slices of `field` [z, y, x] or [C, z, y, x] across z, x and y.

    y (or z) is up; the largest value is white. Where some are negative, `diverge` shows their mean.
    """
    colors = (field if field.ndim == 4 else field[None]).detach().expand(3, -1, -1, -1)
    cells = colors.permute(1, 2, 3, 0).float().cpu().numpy()
    values = cells / find_high(np.abs(cells))
    values = diverge(values.mean(-1)) if cells.min() < 0 else values
    z, y, x = (size // 2 for size in cells.shape[:3])
    sides = values[z, ::-1], values[:, ::-1, x].transpose(1, 0, 2), values[::-1, y]
    return place_beside([*sides])


def shrink(image: Tensor, most: int) -> Tensor:
    """`image` [3, h, w], so much smaller that neither side has more than `most` pixels.

    Pixels are the means of squares of pixels.
    """
    factor = -(-max(image.shape[1:]) // most)
    return image if factor == 1 else avg_pool2d(image, factor, ceil_mode=True)


def diverging(image: Tensor) -> tuple[np.ndarray, float]:
    """Signed `image` [3, h, w], its colors averaged, as a picture; and the value of full red.

    Negative is blue, zero white.
    """
    values = pixels(image).mean(-1)
    full = max(float(np.quantile(np.abs(values), 0.999)), float(np.finfo(np.float32).tiny))
    return diverge(values / full), full


def diverge(numbers: np.ndarray) -> np.ndarray:
    """Colors [..., 3] of numbers between -1, which is blue, and 1, which is red; 0 is white."""
    number = np.clip(numbers, -1, 1)[..., None]
    strong = np.where(number < 0, np.array(BLUE, np.float32), np.array(RED, np.float32))
    return decode((1 - np.abs(number)) + np.abs(number) * strong)


def place_beside(pictures: list[np.ndarray]) -> np.ndarray:
    """`pictures` in a row, top-aligned, on gray."""
    height = max(len(picture) for picture in pictures)
    row = [
        np.pad(picture, ((0, height - len(picture)), (0, GAP), (0, 0)), constant_values=0.2)
        for picture in pictures
    ]
    return np.concatenate(row, axis=1)[:, :-GAP].astype(np.float32)
