"""Movies hold their frames, in order, at the exposure that was asked for."""

from __future__ import annotations

import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from ddrecon.errors import MissingExtraError
from ddrecon.io.images.movies import SECONDS, encode_frames, write_animation, write_mp4


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


def test_an_mp4_shows_the_frames_in_order(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="MP4 is an extra")
    write_mp4(tmp_path / "ring.mp4", frames())
    read = iio.imread(tmp_path / "ring.mp4", plugin="FFMPEG").astype(float)
    assert read.shape == (7, 18, 24, 3)
    assert np.abs(read[:, :17, :23] - frames())[:, 6:, 6:].mean() < 4
    assert iio.immeta(tmp_path / "ring.mp4", plugin="FFMPEG")["fps"] == pytest.approx(
        7 / SECONDS, rel=1e-2
    )


def test_a_missing_encoder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingExtraError, match=r"MP4 needs .*ddrecon\[mp4\]"):
        write_mp4(tmp_path / "ring.mp4", frames())
    assert not list(tmp_path.iterdir())
