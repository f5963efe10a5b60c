"""Scene files of films: the scene of each frame, in which pictures have their own names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ddrecon.errors import Problems
from ddrecon.io.images.films import FILMS
from ddrecon.io.images.table import read_image
from ddrecon.scene_file.load import SceneFile, require
from ddrecon.scene_file.schema import FRAME, ViewSection


def at_frame(scene_file: SceneFile, number: int) -> SceneFile:
    """The scene of the frame `number` of a film."""

    def own(view: ViewSection) -> ViewSection:
        frame = number + view.frame

        def name(path: Path | None) -> Path | None:
            return path and Path(FRAME.sub(lambda field: field[0].format(frame=frame), str(path)))

        return replace(view, image=name(view.image), mask=name(view.mask), frame=frame)

    tree = scene_file.tree
    return replace(scene_file, tree=replace(tree, views=tuple(map(own, tree.views)), frames=None))


def each_frame(scene_file: SceneFile) -> list[SceneFile]:
    """The scenes of all frames of a film, or the scene itself."""
    frames = scene_file.tree.frames
    return [at_frame(scene_file, number) for number in frames.numbers] if frames else [scene_file]


def require_frames(scene_file: SceneFile) -> None:
    """Raises SceneError unless all pictures are there, FormatError for films that end before."""
    problems, frames = Problems(), each_frame(scene_file)
    for one in frames:
        for index, view in enumerate(one.tree.views):
            for key, path in (("image", view.image), ("mask", view.mask)):
                if path is not None and not problems.are_many:
                    with problems.collecting():
                        require(one, f"views.{index}.{key}", path)
                        if one is frames[-1] and path.suffix.lower() in FILMS:
                            read_image(path, view.frame, view.time)
    problems.raise_any()
