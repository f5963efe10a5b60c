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

FORMAT = 7
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


def _load(path: Path, scene: Mapping[str, Any] | None) -> dict[str, Any]:
    """The state in the file at `path`.

    Raises FormatError where it cannot be used, UsageError where it is not of `scene`.
    """
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
    if scene is not None and (changes := differences(content["scene"], scene)):
        raise UsageError(
            [
                f"{path}: belongs to another scene: {change}; use another output folder"
                for change in changes
            ]
        )
    return dict(content["state"])
