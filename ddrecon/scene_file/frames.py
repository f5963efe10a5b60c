"""Scene files of films: the scene of each frame, in which pictures have their own names."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from ddrecon.errors import Problems
from ddrecon.io.images.films import FILMS, frame_times, nearest_frame
from ddrecon.io.images.table import read_image
from ddrecon.scene_file.load import SceneFile, require
from ddrecon.scene_file.view_schema import FRAME, ViewSection


def at_frame(scene_file: SceneFile, number: int) -> SceneFile:
    """The scene of the frame `number` of a film."""

    def of_frame(view: ViewSection) -> ViewSection:
        frame = number + view.frame

        def name(path: Path | None) -> Path | None:
            return path and Path(FRAME.sub(lambda field: field[0].format(frame=frame), str(path)))

        return replace(view, image=name(view.image), mask=name(view.mask), frame=frame)

    tree = scene_file.tree
    views = tuple(map(of_frame, tree.views))
    return replace(scene_file, tree=replace(tree, views=views, frames=None))


def each_frame(scene_file: SceneFile) -> list[SceneFile]:
    """The scenes of all frames of a film, or the scene itself."""
    frames = scene_file.tree.frames
    return [at_frame(scene_file, number) for number in frames.numbers] if frames else [scene_file]


def require_frames(scene_file: SceneFile) -> None:
    """Raises SceneError unless all pictures are there, and films have one rate.

    FormatError for films that end before.
    """
    problems, frames = Problems(), each_frame(scene_file)
    for frame in frames:
        is_end = frame is frames[0] or frame is frames[-1]
        for key, view, path in _pictures(frame):
            if not problems.are_many:
                with problems.collecting():
                    require(frame, key, path)
                    if is_end and path.suffix.lower() in FILMS:
                        read_image(path, view.frame, view.time)
    problems.raise_any()
    _require_one_rate(scene_file)


def _pictures(scene_file: SceneFile) -> Iterator[tuple[str, ViewSection, Path]]:
    """The images and masks that the scene names: the key, the view and the path of each."""
    for index, view in enumerate(scene_file.tree.views):
        for key, path in (("image", view.image), ("mask", view.mask)):
            if path is not None:
                yield f"views.{index}.{key}", view, path


def _require_one_rate(scene_file: SceneFile) -> None:
    """Raises SceneError where films that are counted together do not show them together."""
    paces = list[tuple[Path, float, list[float]]]()
    numbers = scene_file.tree.frames.numbers if scene_file.tree.frames else ()
    for key, view, path in _pictures(scene_file):
        if not numbers or path.suffix.lower() not in FILMS:
            continue
        times = frame_times(path)
        first = nearest_frame(times, view.time) + view.frame
        rate = (len(times) - 1) / (times[-1] - times[0] or math.inf)
        begin = times[first] if first >= 0 else times[0] + first / (rate or math.inf)
        paces.append((path, rate, [times[first + number] - begin for number in numbers]))
        film, usual, pace = paces[0]
        apart = max(abs(a - b) for a, b in zip(pace, paces[-1][2], strict=True))
        if apart * usual > 0.5 or (rate and usual and not 0.99 < rate / usual < 1.01):
            fault = (
                f"{path.name} has {rate:.5g} frames a second and {film.name} {usual:.5g}: "
                f"frames of the same number come to be {apart:.2g} s apart; give films of one "
                f"constant rate (ffmpeg -i {path.name} -r {usual:.5g} ...)"
            )
            raise scene_file.refused(key, fault)
