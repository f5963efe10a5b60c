"""Movies hold their frames, in order, at the exposure that was asked for."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from ddrecon.io.images.movies import SECONDS, encode_frames, write_animation


def frames() -> np.ndarray:
    """Seven gray pictures of an odd size, from black to brighter than white, each with a brighter
    corner.
    """
    pictures = [np.full((17, 23, 3), level) for level in np.linspace(0, 2.4, 7) * 0.9]
    for picture in pictures:
        picture[:4, :4] += 0.3
    return encode_frames(pictures, 2.0)


def test_white_is_what_was_said() -> None:
    values = [float(frame[10, 10, 0]) for frame in frames()]
    assert values[0] == 0 and values[-2] < values[-1] == 255 and values == sorted(values)
    assert values[1] == np.round(255 * (1.055 * (0.36 / 2.0) ** (1 / 2.4) - 0.055))


def test_an_animation_keeps_every_bit(tmp_path: Path) -> None:
    write_animation(tmp_path / "ring.png", frames())
    assert np.array_equal(
        iio.imread(tmp_path / "ring.png", index=..., plugin="pillow")[..., :3], frames()
    )
    about = iio.immeta(tmp_path / "ring.png", plugin="pillow")
    assert about["loop"] == 0 and about["duration"] == pytest.approx(1000 * SECONDS / 7, abs=1)
