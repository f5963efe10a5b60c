"""Scene files as tensors: the front door `load_scene`."""

from __future__ import annotations

import os
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ddrecon.errors import FormatError
from ddrecon.io.images import read_image
from ddrecon.io.volumes import read_field
from ddrecon.lights import AmbientLight, DirectionalLight, EnvironmentLight, Light, PointLight
from ddrecon.medium import Volume
from ddrecon.scene.build_views import build_views
from ddrecon.scene.build_volume import build_volume
from ddrecon.scene.files import read_referenced
from ddrecon.scene.load import SceneFile, read_scene
from ddrecon.scene.problems import Problems
from ddrecon.scene.schema import AmbientSection, Color, DirectionalSection, FieldFile, PointSection
from ddrecon.world import Scene


def load_scene(
    path: str | os.PathLike[str],
    *,
    overrides: Iterable[str] = (),
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Scene:
    """The scene in the file at `path`, with `overrides` (`key.path=value`), as tensors of `dtype` on `device`.

    Raises SceneError with one line per problem of the scene, or FormatError for a file it names that cannot be used.
    """
    return build_scene(read_scene(path, overrides), dtype=dtype, device=device)


def build_scene(scene_file: SceneFile, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Scene:
    """The scene of a file that was read, as tensors of `dtype` on `device`; raises as `load_scene` does."""
    place, tree, problems = torch.device(device), scene_file.tree, Problems()
    volume, grid = None, None
    with problems.collecting():
        volume = build_volume(scene_file, dtype, place)
        grid = volume.grid
    with problems.collecting():
        views = build_views(scene_file, grid, dtype, place)
    starts: dict[str, Tensor] = {}
    with problems.collecting():
        starts = _starts(scene_file, volume, problems)
    lights: list[Light] = []
    for index in range(len(tree.lights)):
        with problems.collecting():
            lights.append(_build_light(scene_file, index, dtype, place))
    problems.raise_any()
    return Scene(volume, lights, views, tree.render, tree.diffusion, tree.optimize, starts, scene_file.path)


def _starts(scene_file: SceneFile, volume: Volume | None, problems: Problems) -> dict[str, Tensor]:
    """The field each optimized parameter starts from."""
    optimize, starts = scene_file.tree.optimize, {}
    for name, settings in optimize.parameters.items() if optimize else ():
        with problems.collecting():
            start = _start(scene_file, name, settings.init, volume)
            if start is not None:
                starts[name] = start
    return starts


def _start(scene_file: SceneFile, name: str, init: float | FieldFile | None, volume: Volume | None) -> Tensor | None:
    """The field that `init` of parameter `name` describes; what the volume has where it is None; None without a volume."""
    field: Tensor | None = None if volume is None else getattr(volume, name).clone()
    if isinstance(init, FieldFile):
        key = f"optimize.parameters.{name}.init.file"
        values = read_referenced(scene_file, key, init.file, partial(read_field, name=name)).values
        if field is not None and values.shape != tuple(field.shape):
            raise scene_file.refused(key, f"has {list(values.shape)} values [z, y, x] but the volume has {list(field.shape)}")
        return None if field is None else torch.as_tensor(values).to(field)
    if init is not None and field is not None:
        field.fill_(init)
    return field


def _build_light(scene_file: SceneFile, index: int, dtype: torch.dtype, device: torch.device) -> Light:
    section = scene_file.tree.lights[index]

    def tensor(value: Color) -> Tensor:
        return torch.tensor(value, dtype=dtype, device=device)

    def color(value: Color) -> Tensor:
        return tensor(value).view(-1)

    if isinstance(section, DirectionalSection):
        return DirectionalLight(tensor(section.direction), color(section.irradiance))
    if isinstance(section, AmbientSection):
        return AmbientLight(color(section.radiance))
    if isinstance(section, PointSection):
        return PointLight(tensor(section.position), color(section.intensity))
    pixels = read_referenced(scene_file, f"lights.{index}.file", section.file, _read_map)
    radiance = torch.from_numpy(pixels).permute(2, 0, 1).contiguous().to(device, dtype)
    return EnvironmentLight(radiance, tensor(section.scale), tensor(section.rotation), section.directions)


def _read_map(path: Path) -> np.ndarray:
    """The radiance of an environment map, float32 [h, w, 3]; raises FormatError where it is not one."""
    pixels = read_image(path).pixels
    height, width = pixels.shape[:2]
    if height < 2 or width < 3:
        raise FormatError(path, f"an environment map has at least 3 x 2 pixels, and this is {width} x {height}")
    negative = pixels.min(axis=2) < 0
    if negative.any():
        row, column = np.argwhere(negative)[0]
        count = np.count_nonzero(negative)
        raise FormatError(
            path, f"negative radiance at row {row}, column {column} ({count} such pixels); set it to 0: lossy files have some around a sun"
        )
    return pixels
