"""Checkpoints: files of tensors and plain values that hold the state of a run; two are kept.

Each has a description of what the run's result depends on, in plain values, so that only the same
run goes on from it.
"""

from __future__ import annotations

import hashlib
import json
import os
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from ddrecon.errors import DataWarning, FormatError, UsageError
from ddrecon.io.files.atomic import refusals, replace_file_durably
from ddrecon.scene_file.load import SceneFile, describe, referenced_files

FORMAT = 9
"""The version of a checkpoint's contents."""
LAST, PREVIOUS = "last.pt", "previous.pt"
"""The names of the last checkpoint and of the one before it."""
ANEW = "start anew with --overwrite"
UNUSABLE = f"not a usable checkpoint; {ANEW}"
"""The fault of a damaged checkpoint, and what to do."""
MOST_CHANGES = 5
"""Differences that are named."""
LONGEST_VALUE = 80
"""Values of more characters are cut short where they are shown."""
ABSENT = object()


def save_checkpoint(folder: Path, state: dict[str, Any], scene: Mapping[str, Any]) -> None:
    """Writes `state` as the last checkpoint in `folder`, with what describes its `scene`."""
    with (
        replace_file_durably(folder / LAST, kept_as=folder / PREVIOUS) as temporary,
        temporary.open("wb") as stream,
    ):
        try:
            torch.save({"format": FORMAT, "scene": scene, "state": state}, stream)
        except RuntimeError as error:  # in which torch's writer wraps that the disk is full
            raise error.__context__ if isinstance(error.__context__, OSError) else error from None


def newest_checkpoint(folder: Path) -> Path | None:
    """The last checkpoint in `folder`, good or not, else the one before it; None without any."""
    return next((folder / name for name in (LAST, PREVIOUS) if (folder / name).is_file()), None)


def load_checkpoint(
    folder: Path, scene: Mapping[str, Any] | None = None
) -> tuple[dict[str, Any], Path]:
    """The state in the last checkpoint in `folder`, and its file.

    Where that is damaged or gone, it is the one before it, with a warning. Raises FormatError if
    neither can be used, UsageError if there is none or it is not of `scene` (None: of any).
    """
    last, previous = folder / LAST, folder / PREVIOUS
    if newest_checkpoint(folder) is None:
        raise UsageError(f"{last}: there is no checkpoint to resume from; run without --resume")
    try:
        return _load(last, scene), last
    except FormatError as error:
        if not previous.exists():
            raise
        state = _load(previous, scene)
        warnings.warn(
            f"{error.path}: {error.reason.partition(';')[0]}; going on from {previous}",
            DataWarning,
            2,
        )
        return state, previous


def continue_from(loaded: Path) -> None:
    """Makes the checkpoint `loaded` the last one: what was damaged after it goes."""
    with refusals(loaded):
        os.replace(loaded, loaded.with_name(LAST))


def _load(path: Path, scene: Mapping[str, Any] | None) -> dict[str, Any]:
    """The state at `path`; raises FormatError if unusable, UsageError if it is not of `scene`."""
    if not path.is_file():
        raise FormatError(path, f"is missing; {ANEW}")
    try:
        # torch itself does not notice changed bytes, but they are in a zip archive with checksums.
        with zipfile.ZipFile(path) as archive:
            is_whole = archive.testzip() is None
        # Tensors and plain values alone: any other pickle could run code.
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever its reader stumbles on
        raise FormatError(path, UNUSABLE) from error
    if not is_whole or not isinstance(content, dict):
        raise FormatError(path, UNUSABLE)
    if content.get("format") != FORMAT:
        written = content.get("format")
        raise FormatError(
            path, f"a checkpoint of format {written}; this version reads {FORMAT}; {ANEW}"
        )
    if scene is not None:
        text = f"{path}: belongs to another scene; use another output folder"
        require_same(content["scene"], scene, text)
    return dict(content["state"])


def fingerprint(scene_file: SceneFile, dtype: torch.dtype) -> dict[str, Any]:
    """The resolved scene, the contents of the files it names and the precision.

    Less what a resumed run may change: the number of iterations.
    """
    scene = describe(scene_file)
    scene["optimize"].pop("iterations", None)
    contents = {f"the content of {path}": _digest(path) for path in referenced_files(scene_file)}
    return scene | contents | {"--dtype": str(dtype).removeprefix("torch.")}


def require_same(old: Any, new: Any, text: str) -> None:
    """Raises UsageError, beginning with `text`, unless two trees of plain values are the same.

    Its lines read `text: key.path is A there, B now`.
    """
    old, new = _leaves(old, ""), _leaves(new, "")
    pairs = {path: (old.get(path, ABSENT), new.get(path, ABSENT)) for path in old | new}
    changes = [
        f"{text}: {path[1:]} is {_shorten(then)} there, {_shorten(current)} now"
        for path, (then, current) in pairs.items()
        if then != current
    ]
    if len(changes) > MOST_CHANGES:
        changes[MOST_CHANGES:] = [f"{text}: {len(changes) - MOST_CHANGES} more differ"]
    if changes:
        raise UsageError(changes)


def _leaves(tree: Any, path: str) -> dict[str, Any]:
    """The plain values in `tree` by path; a list of numbers, or nothing, counts as one."""
    if isinstance(tree, list) and any(isinstance(entry, Mapping) for entry in tree):
        tree = dict(enumerate(tree))
    if not isinstance(tree, Mapping) or not tree:
        return {path: tree}
    branches = [_leaves(branch, f"{path}.{key}") for key, branch in tree.items()]
    return {at: leaf for leaves in branches for at, leaf in leaves.items()}


def _shorten(value: Any) -> str:
    if value is ABSENT:
        return "absent"
    return json.dumps(value)[:LONGEST_VALUE]


def _digest(path: Path) -> str:
    if path.is_dir():
        return hashlib.sha256(
            "".join(_digest(entry) for entry in sorted(path.iterdir())).encode()
        ).hexdigest()
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from error
