"""Scene files as records: strict YAML, with everything that is wrong reported at once."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

from ddrecon.errors import FormatError, SceneError
from ddrecon.io.files.reading import require_stored
from ddrecon.scene_file.nodes import Node, parse
from ddrecon.scene_file.overrides import override
from ddrecon.scene_file.parameters import require_parameters
from ddrecon.scene_file.problems import Problems
from ddrecon.scene_file.read import Rule, read_record
from ddrecon.scene_file.schema import SceneTree, ViewSection, ViewSource
from ddrecon.scene_file.view_sources import name_listed, views_of
from ddrecon.settings import ParameterSettings

T = TypeVar("T")
FINISH: dict[Any, Callable[[Node, Any, Path], Any]] = {
    (Mapping, ParameterSettings): require_parameters,
    (tuple, ViewSection): name_listed,
    ViewSource: views_of,
}
"""What is made of all records of a list or mapping, or of one that stands for others."""

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
    try:
        rule = Rule(SceneTree, path.absolute().parent, {}, FINISH)
        tree = read_record(root, SceneTree, rule).named_once()
    except SceneError as error:
        raise SceneError([*problems.lines, *error.problems]) from None
    problems.raise_any()
    return SceneFile(tree, path, {node.key: node.where for node in root.walk()})


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


def read_referenced(scene_file: SceneFile, key: str, path: Path, read: Callable[[Path], T]) -> T:
    """The content of the file `path` named at `key`, as `read` returns it.

    Raises SceneError if there is no such file, FormatError if it is unusable.
    """
    require(scene_file, key, path)
    return read(path)


def require(scene_file: SceneFile, key: str, path: Path) -> None:
    """Raises SceneError unless `path`, named at `key`, is a file."""
    try:
        is_file, exists = path.is_file(), path.exists()
    except OSError as error:
        raise scene_file.refused(
            key, f"{path} cannot be reached: {error.strerror or error}"
        ) from error
    if not is_file:
        raise scene_file.refused(key, f"{path} {'is not a file' if exists else 'does not exist'}")


def referenced_files(scene_file: SceneFile) -> list[Path]:
    """Every file that the scene names, each once, in the order of the scene."""
    return list(dict.fromkeys(_paths(scene_file.tree)))


def _paths(value: Any) -> Iterator[Path]:
    if isinstance(value, Path):
        yield value
    elif is_dataclass(value):
        for field in fields(value):
            yield from _paths(getattr(value, field.name))
    elif isinstance(value, Mapping | tuple):
        for entry in value.values() if isinstance(value, Mapping) else value:
            yield from _paths(entry)
