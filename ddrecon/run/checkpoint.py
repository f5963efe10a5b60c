"""Checkpoints: files of tensors and plain values that hold the state of a run; two are kept."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from ddrecon.errors import DataWarning, FormatError, UsageError
from ddrecon.io.files.atomic import replace_file_durably
from ddrecon.run.differences import differences

FORMAT = 6
"""What a checkpoint holds; counts up when that changes."""
LAST, PREVIOUS = "last.pt", "previous.pt"
"""The names of the last checkpoint and of the one before it."""
ANEW = "start anew with --overwrite"
UNUSABLE = f"not a usable checkpoint; {ANEW}"
"""What is wrong with a damaged checkpoint, and what to do."""


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


def load_checkpoint(folder: Path, scene: Mapping[str, Any]) -> tuple[dict[str, Any], Path]:
    """The state in the last checkpoint in `folder`, and its file.

    Where that is damaged, it is the one before it, with a warning. Raises FormatError if neither
    can be used, UsageError if there is none or it is not of this `scene`.
    """
    last, previous = folder / LAST, folder / PREVIOUS
    if not last.exists() and not previous.exists():
        raise UsageError(f"{last}: there is no checkpoint to resume from; run without --resume")
    try:
        return _check(last, _load(last), scene), last
    except FormatError as error:
        if not previous.exists():
            raise
        state = _check(previous, _load(previous), scene)
        warnings.warn(
            f"{error.path}: {error.reason.partition(';')[0]}; going on from {previous}",
            DataWarning,
            2,
        )
        return state, previous


def read_state(path: Path) -> dict[str, Any]:
    """The state in the checkpoint at `path`, of whatever scene; raises FormatError."""
    content = _load(path)
    if content.get("format") != FORMAT:
        raise FormatError(path, UNUSABLE)
    return dict(content["state"])


def forget_checkpoints(folder: Path) -> None:
    """Removes the checkpoints in `folder`."""
    for name in (LAST, PREVIOUS):
        (folder / name).unlink(missing_ok=True)


def _load(path: Path) -> dict[str, Any]:
    """What is in the file at `path`; raises FormatError where it cannot be used."""
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
    return content


def _check(path: Path, content: dict[str, Any], scene: Mapping[str, Any]) -> dict[str, Any]:
    if content.get("format") != FORMAT:
        written = content.get("format")
        raise FormatError(
            path, f"a checkpoint of format {written}; this version reads {FORMAT}; {ANEW}"
        )
    if changes := differences(content["scene"], scene):
        raise UsageError(
            [
                f"{path}: belongs to another scene: {change}; use another output folder"
                for change in changes
            ]
        )
    return dict(content["state"])
