"""What a run's result depends on, in plain values, and how two such descriptions differ."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
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
    scene["optimize"].pop("iterations", None)
    for settings in scene["optimize"]["parameters"].values():
        settings.pop("lr", None)
    contents = {f"the content of {path}": _digest(path) for path in referenced_files(scene_file)}
    return scene | contents | {"--dtype": str(dtype).removeprefix("torch.")}


def differences(old: Any, new: Any, key: str = "") -> list[str]:
    """The differences between two trees of mappings, lists and plain values, a text for each.

    A text reads `key.path is A there, B now`; `key` is where both trees stand.
    """
    one, other = _entries(old), _entries(new)
    if one is None or other is None:
        return [f"{key} is {_shorten(old)} there, {_shorten(new)} now"] if old != new else []
    return [
        text
        for name in dict.fromkeys([*one, *other])
        for text in differences(
            one.get(name, ABSENT), other.get(name, ABSENT), f"{key}.{name}" if key else str(name)
        )
    ]


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
