"""The frame of a film that is asked for is the one that is read, or there is a line."""

import pytest
from film_files import H264, ffmpeg, number_of, write_film

from ddrecon.errors import FormatError
from ddrecon.io.images.films import frame_times
from ddrecon.io.images.table import read_image

PAUSES = "floor(N/7)*3 + mod(N,2)*0.4"
COUNT = 135
KINDS: dict[str, tuple[str, str, tuple[str, ...], str]] = {
    "rate that ffmpeg prints rounded": (".mp4", "1004/1000", H264, "0"),
    "times in milliseconds": (".mkv", "60000/1001", H264, "0"),
    "variable rate": (".mp4", "30", H264, PAUSES),
    "variable rate in milliseconds": (".mkv", "30", H264, PAUSES),
    "pause": (".mov", "30", H264, "gte(N,40)*200"),
    "late start": (".mkv", "25", (*H264, "-output_ts_offset", "3.37"), "0"),
    "pieces": (".mp4", "25", (*H264, "-movflags", "frag_keyframe+empty_moov"), "0"),
    "hidden frames": (".webm", "25", ("-c:v", "libvpx-vp9", "-lag-in-frames", "9"), "0"),
}


def shown(path, number, time=0.0):
    return number_of(read_image(path, number, time).pixels)


@pytest.mark.parametrize("kind", KINDS)
def test_the_frame_that_is_asked_for_is_read(tmp_path, kind):
    suffix, rate, options, shift = KINDS[kind]
    path = tmp_path / f"film{suffix}"
    write_film(path, COUNT, rate, *options, shift=shift)
    assert len(frame_times(path)) == COUNT
    assert [shown(path, number) for number in (0, 1, 63, 134)] == [0, 1, 63, 134]
    with pytest.raises(FormatError, match=f"no frame {COUNT}, .* it has {COUNT} frames"):
        read_image(path, COUNT)


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_what_was_cut_off_is_not_counted(tmp_path, suffix):
    """A cut without encoding keeps what its first frame is decoded from, or begins there."""
    whole, part = tmp_path / "whole.mp4", tmp_path / f"part{suffix}"
    write_film(whole, COUNT, "25", *H264)
    ffmpeg("-ss", "1.8", "-i", whole, "-c", "copy", part)
    first = COUNT - len(frame_times(part))
    assert first == 45 or suffix == ".mkv"
    assert [shown(part, number) for number in (0, 1, 70)] == [first, first + 1, first + 70]


def test_frames_are_counted_from_the_one_nearest_to_a_time(tmp_path):
    path = tmp_path / "film.mp4"
    write_film(path, 60, "30", *H264, shift="gte(N,30)*60")
    times = frame_times(path)
    assert times == pytest.approx([n / 30 + 2 * (n >= 30) for n in range(60)])
    for time, number in ((0.034, 1), (1.9, 29), (2.1, 30), (3.3, 39)):
        assert shown(path, 0, time) == number and shown(path, 5, time) == number + 5


def test_a_film_is_read_as_it_is_held(tmp_path):
    """Turned as telephones turn theirs, and without the picture of its cover."""
    film, turned, red = (tmp_path / name for name in ("film.mp4", "turned.mp4", "red.png"))
    write_film(film, 4, "25", *H264)
    ffmpeg("-f", "lavfi", "-i", "color=red:s=90x80", "-frames:v", "1", red)
    both = ["-i", red, "-display_rotation", "90", "-i", film, "-map", "0", "-map", "1"]
    ffmpeg(*both, "-c:v:0", "png", "-c:v:1", "copy", "-disposition:v:0", "attached_pic", turned)
    pixels = read_image(turned, 3).pixels
    assert pixels.shape == (32, 16, 3) and number_of(pixels.swapaxes(0, 1)[:, ::-1]) == 3


def test_a_damaged_frame_is_refused(tmp_path):
    path = tmp_path / "film.mkv"
    write_film(path, 9, "25", "-c:v", "png")
    half, content = path.stat().st_size // 2, bytearray(path.read_bytes())
    content[half : half + 20] = bytes(20)
    path.write_bytes(content)
    assert shown(path, 0) == 0
    with pytest.raises(FormatError, match="frame 4 is damaged"):
        read_image(path, 4)


@pytest.mark.parametrize(
    ("suffix", "options"),
    [
        (".mov", ("-c:v", "prores_ks", "-pix_fmt", "yuva444p10le")),
        (".mkv", ("-c:v", "png", "-pix_fmt", "rgba")),
        (".webm", ("-c:v", "libvpx-vp9", "-pix_fmt", "yuva420p")),
    ],
)
def test_films_with_alpha_are_refused(tmp_path, suffix, options):
    """It would be lost: what is transparent would be as bright as what is not."""
    path = tmp_path / f"film{suffix}"
    ffmpeg("-f", "lavfi", "-i", "color=red@0.5:s=32x16:d=0.2,format=rgba", *options, path)
    with pytest.raises(FormatError, match="has alpha, and does not say"):
        read_image(path)
