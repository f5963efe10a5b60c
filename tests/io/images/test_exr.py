"""EXR: the one part and the channels that are a picture are read, whatever else there is."""

from pathlib import Path

import numpy as np
import pytest
from image_files import write_exr, write_parts
from refusals import image_refusal

from ddrecon.io.images.table import read_image

RNG = np.random.default_rng(0)


def part(names: str, dtype: str = "f4") -> tuple[list[str], np.ndarray]:
    """Channels by their `names`, with random values."""
    channels = names.split()
    return channels, (9 * RNG.random((3, 5, len(channels)))).astype(dtype)


OTHERS = {
    "depth": part("Z"),
    "matte": part("A"),
    "normals": part("N.X N.Y N.Z"),
    "crypto": part("crypto00.R crypto00.G crypto00.B crypto00.A"),
    "id": part("id", "u4"),
}


@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("names", ["R G B A", "R G B", "Y", "Y A"])
@pytest.mark.parametrize("is_first", [True, False])
def test_the_part_that_is_a_picture_is_read(
    tmp_path: Path, other: str, names: str, is_first: bool
) -> None:
    picture = part(names)
    parts = {"beauty": picture, other: OTHERS[other]}
    order = dict(reversed(parts.items())) if is_first else parts
    image = read_image(write_parts(tmp_path / "a.exr", order))
    values = picture[1]
    colors = values[..., :3] if "R" in names else np.repeat(values[..., :1], 3, 2)
    assert np.array_equal(image.pixels, colors)
    assert (image.coverage is not None) == ("A" in names)
    assert image.coverage is None or np.array_equal(image.coverage, values[..., -1])


@pytest.mark.parametrize("other", OTHERS)
def test_other_channels_beside_colors_are_left_out(tmp_path: Path, other: str) -> None:
    """But an A, which is alpha."""
    names, values = part("R G B")
    others, more = OTHERS[other]
    both = np.concatenate([values, more.astype("f4")], 2)
    image = read_image(write_exr(tmp_path / "a.exr", [*names, *others], both))
    assert np.array_equal(image.pixels, values) and (image.coverage is None) == (other != "matte")


NO_PICTURE = ["Z", "A", "depth", "N.x", "R", "mask", "depth normal", "RY BY Y", "U V"]
NO_PICTURE += ["beauty.R beauty.G beauty.B", "diffuse.R diffuse.G diffuse.B Z"]


@pytest.mark.parametrize("names", NO_PICTURE)
def test_channels_that_are_no_picture_are_refused_by_their_names(
    tmp_path: Path, names: str
) -> None:
    told = image_refusal(write_exr(tmp_path / "a.exr", *part(names)))
    assert "no picture among its channels" in told
    assert all(name in told for name in names.split())
    told = image_refusal(write_parts(tmp_path / "b.exr", {"one": part(names), "two": part("Z")}))
    assert "no picture" in told and "one: " in told and "two: Z" in told


@pytest.mark.parametrize("names", ["R G B A", "Y"])
def test_of_two_pictures_none_is_chosen(tmp_path: Path, names: str) -> None:
    parts = {"left": part(names), "depth": part("Z"), "right": part(names)}
    told = image_refusal(write_parts(tmp_path / "a.exr", parts))
    assert "several parts that are pictures (left: " in told and "right: " in told


def test_whole_numbers_are_refused(tmp_path: Path) -> None:
    told = image_refusal(write_exr(tmp_path / "a.exr", *part("R G B", "u4")))
    assert "holds samples of type uint; save it as half" in told
