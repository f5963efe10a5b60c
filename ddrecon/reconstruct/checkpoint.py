"""Checkpoints: the state of a run in one file of tensors and plain values. Never a pickle of anything else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from ddrecon.errors import FormatError, SceneError
from ddrecon.io.atomic import replacing

FORMAT = 2
"""What a checkpoint holds; counts up when that changes."""


def save_checkpoint(path: Path, state: dict[str, Any], scene_text: str) -> None:
    """Writes `state`, and the text of the scene it belongs to, to `path`: to a temporary name first, then renamed."""
    with replacing(path) as temporary:
        torch.save({"format": FORMAT, "scene": scene_text, "state": state}, temporary)


def load_checkpoint(path: Path, scene_text: str) -> dict[str, Any]:
    """The state in the checkpoint at `path`; raises FormatError if it is damaged, SceneError if it is not of this scene."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        written, saved, state = content["format"], content["scene"], content["state"]
    except FileNotFoundError:
        raise SceneError(f"{path}: there is no checkpoint to resume from; run without --resume") from None
    except Exception as error:  # torch raises whatever its reader stumbles on
        raise FormatError(path, "not a usable checkpoint; start anew without --resume") from error
    if written != FORMAT:
        raise FormatError(path, f"a checkpoint of format {written}; this version reads {FORMAT}; start anew without --resume")
    if saved != scene_text:
        lines = zip(saved.splitlines(), scene_text.splitlines(), strict=False)
        old, new = next(((a, b) for a, b in lines if a != b), ("(shorter)", "(longer)"))
        raise SceneError(f"{path}: belongs to another scene: {old.strip()!r} there, {new.strip()!r} now; use another output folder")
    return dict(state)
