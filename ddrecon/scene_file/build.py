"""Scene files as tensors: the front door `load_scene`."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import replace

import torch

from ddrecon.errors import UsageError
from ddrecon.layer import DTYPES
from ddrecon.light.lights import Light
from ddrecon.march.steps import choose_steps
from ddrecon.scene import Scene
from ddrecon.scene_file.build_lights import build_lights
from ddrecon.scene_file.build_starts import (
    build_starts,
    require_start_files,
)
from ddrecon.scene_file.build_views import build_views
from ddrecon.scene_file.build_volume import build_volume
from ddrecon.scene_file.choices import choose_rounds, share_colors
from ddrecon.scene_file.load import SceneFile, read_scene
from ddrecon.scene_file.problems import Problems
from ddrecon.variables.values import name_each


def load_scene(
    path: str | os.PathLike[str],
    *,
    overrides: Iterable[str] = (),
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Scene:
    """The scene in the file at `path`, as tensors of `dtype` on `device`.

    `overrides` (`key.path=value`) are put in first.

    Raises SceneError with one line per problem of the scene, FormatError for a file it names that
    cannot be used, or UsageError for another `dtype` than `DTYPES` and a `device` that is not here.
    """
    if dtype not in DTYPES:
        raise UsageError(f"dtype {dtype}: light is computed in float32 or float64")
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise UsageError(f"device {device}: {error}") from None
    return build_scene(read_scene(path, overrides), dtype=dtype, device=device)


def build_scene(
    scene_file: SceneFile, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> Scene:
    """The scene of a file that was read, as tensors; `load_scene` says what is raised."""
    place, tree, problems = torch.device(device), share_colors(scene_file.tree), Problems()
    scene_file = replace(scene_file, tree=tree)
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
    diffusion = choose_rounds(tree, volume.phase, volume)
    render = tree.render
    if render.steps_per_voxel is None:
        render = replace(render, steps_per_voxel=choose_steps(volume))
    scene = Scene(volume, lights, views, render, diffusion, optimize, path=scene_file.path)
    return replace(scene, starts=build_starts(scene_file, scene))
