"""Films of one scene are counted together, so they must be shown together."""

from collections.abc import Callable
from pathlib import Path

import pytest
from example_scene import changed
from film_files import H264, write_film

from ddrecon.errors import SceneError
from ddrecon.scene_file.build_views import require_frames
from ddrecon.scene_file.load import SceneFile

CAMERA = {"type": "perspective", "origin": [0, 0.3, 3.2], "target": [0, 0, 0], "fov": 28}


@pytest.mark.parametrize(
    ("rate", "shift", "frames", "own", "apart"),
    [
        ("25", "0", (0, 30), {"time": 0.3}, ""),
        ("30", "0", (0, 30), {}, "30 frames a second and front.mp4 25: .* 0.2 s apart"),
        ("30", "0", (3, 3), {"time": 0.3}, " 0.02 s apart"),
        ("25", "gte(N,20)*5", (0, 30), {}, " 0.2 s apart"),
        ("25", "gte(N,20)*0.3", (0, 30), {}, ""),
    ],
)
def test_films_of_other_rates_are_refused(
    read: Callable[..., SceneFile],
    tmp_path: Path,
    rate: str,
    shift: str,
    frames: tuple[int, int],
    own: dict[str, float],
    apart: str,
) -> None:
    write_film(tmp_path / "front.mp4", 40, "25", *H264)
    write_film(tmp_path / "side.mov", 45, rate, *H264, shift=shift)
    views = [{"image": "front.mp4", "camera": CAMERA}, {"image": "side.mov", "camera": CAMERA}]
    views[1] |= own
    first, last = frames
    scene_file = read(changed(views=views, frames={"first": first, "last": last}))
    if not apart:
        require_frames(scene_file)
        return
    with pytest.raises(SceneError, match=rf"views\.1\.image: side\.mov has .*{apart}"):
        require_frames(scene_file)
