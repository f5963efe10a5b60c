"""Scene files as tensors: the front door `load_scene`."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import replace

import torch

from ddrecon.light.lights import Light
from ddrecon.medium.phase import PhaseFunction
from ddrecon.scene import Scene
from ddrecon.scene_file.build_lights import build_lights
from ddrecon.scene_file.build_starts import (
    build_starts,
    build_support,
    require_start_files,
)
from ddrecon.scene_file.build_views import build_views
from ddrecon.scene_file.build_volume import build_volume
from ddrecon.scene_file.load import SceneFile, read_scene
from ddrecon.scene_file.problems import Problems
from ddrecon.settings import DiffusionSettings
from ddrecon.variables.kinds import PHASE
from ddrecon.variables.wildcards import name_each

MORE_ROUNDS = 0.3, 0.6
"""A second moment of the phase function above one of these deserves a round more: by about so much
a round multiplies what is left. For Henyey-Greenstein that is a |g| of 0.55 and 0.77.
"""
FEW_ANGLES = 0.1
"""A second moment up to this needs no angles beyond diffusion's; |g| is up to 0.32 then."""
SOUGHT = 0.31
"""The second moment that stands for a phase function which is sought: two rounds."""


def load_scene(
    path: str | os.PathLike[str],
    *,
    overrides: Iterable[str] = (),
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Scene:
    """The scene in the file at `path`, as tensors of `dtype` on `device`.

    `overrides` (`key.path=value`) are put in first.

    Raises SceneError with one line per problem of the scene, or FormatError for a file it names
    that cannot be used.
    """
    return build_scene(read_scene(path, overrides), dtype=dtype, device=device)


def build_scene(
    scene_file: SceneFile, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> Scene:
    """The scene of a file that was read, as tensors; `load_scene` says what is raised."""
    place, tree, problems = torch.device(device), scene_file.tree, Problems()
    volume, grid = None, None
    with problems.collecting():
        volume = build_volume(scene_file, dtype, place)
        grid = volume.grid
    with problems.collecting():
        views = build_views(scene_file, grid, dtype, place)
    lights: list[Light] = []
    with problems.collecting():
        lights = build_lights(scene_file, dtype, place)
    require_start_files(scene_file, problems)
    problems.raise_any()
    optimize = tree.optimize
    if optimize is not None:
        optimize = replace(optimize, parameters=name_each(optimize.parameters, views))
    sought = () if optimize is None else optimize.parameters
    is_phase_sought = any(name == "g" or name.startswith(PHASE) for name in sought)
    diffusion = _choose_rounds(tree.diffusion, volume.phase, is_phase_sought)
    scene = Scene(volume, lights, views, tree.render, diffusion, optimize, path=scene_file.path)
    support = build_support(scene_file, volume.density)
    return replace(scene, starts=build_starts(scene_file, scene), support=support)


def _choose_rounds(
    settings: DiffusionSettings, phase: PhaseFunction, is_phase_sought: bool
) -> DiffusionSettings:
    """`settings`, with transport rounds and degree as `phase` deserves where they were left out.

    A phase function that is sought may become any: it starts as one of strong peaks does.
    """
    if not settings.rounds:
        return settings
    left = float(phase.moments(3)[:, 2].abs().max())
    if is_phase_sought:
        left = max(left, SOUGHT)
    rounds, degree = 1 + sum(left > bound for bound in MORE_ROUNDS), 3 if left > FEW_ANGLES else 1
    return replace(
        settings,
        transport_rounds=rounds if settings.transport_rounds is None else settings.transport_rounds,
        degree=degree if settings.degree is None else settings.degree,
    )
