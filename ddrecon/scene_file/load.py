"""Scene files as records: strict YAML, with everything that is wrong reported at once."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from ddrecon.errors import FormatError, SceneError
from ddrecon.io.files.reading import require_stored
from ddrecon.scene_file.nodes import Node, parse
from ddrecon.scene_file.overrides import override
from ddrecon.scene_file.problems import Problems
from ddrecon.scene_file.records import read_record
from ddrecon.scene_file.schema import SceneTree

MAX_BYTES = 2**20
"""A scene file is no larger; thousands of views fit."""


@dataclass(frozen=True)
class SceneFile:
    """A scene file that was read.

    `tree` is its content, `path` where it lies, and `marks` are the `file:line:column` of each
    value by key path.
    """

    tree: SceneTree
    path: Path
    marks: Mapping[str, str]

    def refused(self, key: str, what: str) -> SceneError:
        """The error that says `what` is wrong with the value at `key`.

        It points to the nearest value above it where it was not written itself.
        """
        nearest = key
        while nearest and nearest not in self.marks:
            nearest = nearest.rpartition(".")[0]
        return SceneError(f"{self.marks[nearest]}: {key}: {what}")


def read_scene(path: str | os.PathLike[str], overrides: Iterable[str] = ()) -> SceneFile:
    """The scene file at `path` with `overrides` (`key.path=value`) put in.

    Raises SceneError with one line per problem.
    """
    path = Path(path)
    problems = Problems()
    try:
        root = parse(_text(path), lambda line, column: f"{path}:{line}:{column}", problems)
    except SceneError as error:
        raise SceneError([*problems.lines, *error.problems]) from None
    if root.value is None:
        raise root.refused("is empty")
    for text in overrides:
        with problems.collecting():
            override(root, text, problems)
    tree = _tree(root, path.absolute().parent, problems)
    return SceneFile(tree, path, {node.key: node.where for node in root.walk()})


def _tree(root: Node, folder: Path, problems: Problems) -> SceneTree:
    try:
        tree = read_record(root, SceneTree, folder)
    except SceneError as error:
        raise SceneError([*problems.lines, *error.problems]) from None
    problems.raise_any()
    return tree


def _text(path: Path) -> str:
    try:
        require_stored(path)
        with path.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except FormatError as error:
        raise SceneError(str(error)) from error
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror or error}") from error
    if len(data) > MAX_BYTES:
        raise SceneError(f"{path}: is larger than {MAX_BYTES // 2**20} MiB; it is not a scene file")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        column = error.start - data.rfind(b"\n", 0, error.start)
        raise SceneError(f"{path}:{line}:{column}: is not UTF-8 text") from error
