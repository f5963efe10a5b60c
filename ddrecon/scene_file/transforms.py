"""Camera files of NeRF, instant-ngp and nerfstudio (`transforms.json`) as the views they stand for.

What a frame says takes precedence over what the file says. Poses are camera to world with OpenGL
axes and stay as they stand: what tells other programs how to map them into a box of their own
(`scale`, `offset`, `aabb_scale`, `applied_transform`) is not for us.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ddrecon.errors import FormatError, SceneError
from ddrecon.scene_file.leaves import Rule, read_each, read_list, read_path, read_text
from ddrecon.scene_file.nodes import Node, describe_found
from ddrecon.scene_file.problems import Problems
from ddrecon.scene_file.schema import ViewSection
from ddrecon.scene_file.transforms_camera import Entries, read_camera
from ddrecon.scene_file.view_names import name_views

MAX_BYTES = 64 * 2**20
TEST_NAME = re.compile(r"(?<![a-z])(test|val)(?![a-z])", re.IGNORECASE)
TRAIN_NAME = re.compile(r"(?<![a-z])train(?![a-z])", re.IGNORECASE)
LISTS = ("train_filenames", "test_filenames", "val_filenames")


def read_transforms(
    node: Node, paths: Sequence[Path], test_every: int | None
) -> tuple[ViewSection, ...]:
    """The views in the files `paths`, which `node` of a scene names, called as their images.

    Of every `test_every` views of a file that does not say which are test views, the first is one.
    Raises SceneError or FormatError.
    """
    problems, views = Problems(), list[ViewSection]()
    for path in paths:
        with problems.collecting():
            document = _document(node, path)
            try:
                views += _file_views(document, path, test_every)
            except SceneError as error:
                first, *others = error.problems
                raise FormatError(path, first.removeprefix(f"{path}: "), others) from error
    problems.raise_any()
    names = name_views([view.image for view in views])
    return tuple(replace(view, name=name) for view, name in zip(views, names, strict=True))


def _document(node: Node, path: Path) -> Node:
    if not path.is_file():
        raise node.refused(f"{path} does not exist, or is not a file")
    try:
        if path.stat().st_size > MAX_BYTES:
            raise FormatError(
                path, f"is larger than {MAX_BYTES // 2**20} MiB; it holds more than cameras"
            )
        return _node("", str(path), json.loads(path.read_bytes(), parse_int=_whole))
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise FormatError(path, f"not JSON: {error}") from error


def _whole(digits: str) -> int | float:
    """A whole number; infinite where no arithmetic could be done with it."""
    return int(digits) if len(digits) < 300 else float(digits)


def _node(key: str, where: str, value: Any) -> Node:
    """`value`, as JSON has it, as a node at `key` and all those below it."""
    node = Node(key, where, where, None)
    if isinstance(value, dict):
        node.value = {
            name: _node(node.child_key(name), where, entry) for name, entry in value.items()
        }
    elif isinstance(value, list):
        node.value = [
            _node(node.child_key(index), where, entry) for index, entry in enumerate(value)
        ]
    else:
        node.value = value
    return node


def _file_views(root: Node, path: Path, test_every: int | None) -> list[ViewSection]:
    if not isinstance(root.value, dict) or "frames" not in root.value:
        raise root.refused(
            "has no 'frames'; expected a transforms.json as of NeRF, instant-ngp or nerfstudio"
        )
    frames = read_list(root.value["frames"])
    rule = Rule(str, {}, path.absolute().parent)
    splits = _splits(root.value, path, frames, rule, test_every)
    if not any(splits):
        raise root.refused("its lists of files name no frame")
    problems, views = Problems(), []
    for frame, split in zip(frames, splits, strict=True):
        if split is None:
            continue
        with problems.collecting():
            if not isinstance(frame.value, dict):
                raise frame.refused(f"expected a mapping, found {describe_found(frame)}")
            image, mask = (
                _image(frame.value, rule),
                read_path(frame.value["mask_path"], rule) if frame.value.get("mask_path") else None,
            )
            camera = read_camera(frame, root.value | frame.value, rule)
            if image is None and camera.resolution is None:
                raise frame.refused(
                    "has neither file_path nor w and h, so that its number of pixels is unknown"
                )
            views.append(ViewSection("", camera, image, mask, split))
    problems.raise_any()
    return views


def _splits(
    entries: Entries, path: Path, frames: list[Node], rule: Rule, test_every: int | None
) -> list[str | None]:
    """The split of each frame; None for one that the file's lists leave out, as nerfstudio does.

    Lists of the file say so, or its name (`transforms_test.json`), or it is one in `test_every`.
    """
    if any(name in entries for name in LISTS):
        names = [_name(frame) for frame in frames]
        train, test, val = (_listed(entries.get(name), names, rule) for name in LISTS)
        is_open = "train_filenames" not in entries
        return [
            "test" if name in test | val else "train" if is_open or name in {*train, None} else None
            for name in names
        ]
    if TEST_NAME.search(path.stem) or TRAIN_NAME.search(path.stem) or test_every is None:
        return ["test" if TEST_NAME.search(path.stem) else "train"] * len(frames)
    return ["train" if index % test_every else "test" for index in range(len(frames))]


def _name(frame: Node) -> Path | None:
    """What lists call the `frame`, if anything."""
    name = frame.value.get("file_path") if isinstance(frame.value, dict) else None
    return Path(name.value) if name is not None and isinstance(name.value, str) else None


def _listed(node: Node | None, names: Sequence[Path | None], rule: Rule) -> set[Path]:
    """The frames that a list of the file names; raises SceneError for one that there is not."""

    def read_name(entry: Node, rule: Rule) -> Path:
        name = Path(read_text(entry, rule))
        if name not in names:
            raise entry.refused(f"no frame has the file_path {entry.value!r}")
        return name

    return set() if node is None else set(read_each(node.children(), rule, read_name))


def _image(entries: Entries, rule: Rule) -> Path | None:
    """The frame's image, a .png where its name has no suffix of an image."""
    from ddrecon.io.images.table import READERS

    if "file_path" not in entries:
        return None
    path = read_path(entries["file_path"], rule)
    return path if path.suffix.lower() in READERS else path.with_name(f"{path.name}.png")
