"""What a run's result depends on, in plain values, and how two such descriptions differ."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from ddrecon.errors import FormatError
from ddrecon.scene_file.dump import describe
from ddrecon.scene_file.load import SceneFile, referenced_files

LONGEST = 80
"""Values of more characters are cut short where they are shown."""
ABSENT = object()


def fingerprint(scene_file: SceneFile, dtype: torch.dtype) -> dict[str, Any]:
    """The resolved scene, the contents of the files it names and the precision.

    Less what a resumed run may change: the number of iterations, and learning rates.
    """
    scene = describe(scene_file)
    settings = {
        name: _without(given, "lr") for name, given in scene["optimize"]["parameters"].items()
    }
    scene["optimize"] = {**_without(scene["optimize"], "iterations"), "parameters": settings}
    contents = {f"the content of {path}": _digest(path) for path in referenced_files(scene_file)}
    return scene | contents | {"--dtype": str(dtype).removeprefix("torch.")}


def differences(old: Any, new: Any) -> list[str]:
    """The differences between two trees of mappings, lists and plain values, a text for each.

    A text reads `key.path is A there, B now`.
    """
    return [
        f"{key} is {_shorten(before)} there, {_shorten(after)} now"
        for key, before, after in _changes("", old, new)
    ]


def _changes(key: str, old: Any, new: Any) -> Iterator[tuple[str, Any, Any]]:
    old_entries, new_entries = _entries(old), _entries(new)
    if old_entries is None or new_entries is None:
        if old != new:
            yield key, old, new
        return
    for name in dict.fromkeys([*old_entries, *new_entries]):
        yield from _changes(
            f"{key}.{name}" if key else str(name),
            old_entries.get(name, ABSENT),
            new_entries.get(name, ABSENT),
        )


def _entries(value: Any) -> Mapping[Any, Any] | None:
    """The children of `value` by name or number; None if it has none.

    A list of numbers counts as one value, and is shown whole.
    """
    if isinstance(value, Mapping):
        return value
    if isinstance(value, list) and any(isinstance(entry, Mapping) for entry in value):
        return dict(enumerate(value))
    return None


def _shorten(value: Any) -> str:
    if value is ABSENT:
        return "absent"
    text = json.dumps(value)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def _without(entries: Mapping[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in entries.items() if key != name}


def _digest(path: Path) -> str:
    """The SHA-256 of the file at `path`, or of those of all files in the folder `path`."""
    if path.is_dir():
        return hashlib.sha256(
            "".join(_digest(entry) for entry in sorted(path.iterdir())).encode()
        ).hexdigest()
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from error
