"""What a run has found, for its report, its page while it runs, and its diagnoses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.reconstruct.log import Row
from ddrecon.renderer import LightField, solve_light
from ddrecon.scene import Scene
from ddrecon.variables.values import value_of


@dataclass(frozen=True)
class Findings:
    """The `scene` as found, `images` and quality by view, and the log.

    `given` are the fields of the scene file in whose place others were found, by name.
    """

    scene: Scene
    given: Mapping[str, Tensor]
    light_field: LightField
    images: Mapping[str, Tensor]
    quality: Mapping[str, Mapping[str, Any]]
    rows: Sequence[Row]
    summary: Mapping[str, Any]
    environment: Mapping[str, Any]
    settings: str


def given_fields(scene: Scene) -> dict[str, Tensor]:
    """The fields of `scene` that are optimized but start from something else: the truth, perhaps.

    What is the same in every cell is not told.
    """
    given = {}
    for name, start in scene.starts.items():
        if name.startswith(("lights.", "views.")):
            continue
        value = value_of(scene, name)
        if value.ndim >= 3 and bool((value != value.flatten()[0]).any()):
            is_start = start.shape == value.shape and torch.equal(start, value)
            if not is_start:
                given[name] = value
    return given


def solve(scene: Scene) -> LightField:
    """The light in `scene`, without derivatives."""
    with torch.no_grad():
        return solve_light(scene, SolveMemory())
