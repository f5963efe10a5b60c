"""Files a scene refers to: absent ones are the scene's mistake, unusable ones the file's."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

from ddrecon.scene_file.load import SceneFile

T = TypeVar("T")


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
