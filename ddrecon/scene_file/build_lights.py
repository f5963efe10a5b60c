"""The lights section as tensors."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ddrecon.errors import DataWarning, FormatError
from ddrecon.io.images.table import read_image
from ddrecon.light.lights import AmbientLight, DirectionalLight, EnvironmentLight, Light, PointLight
from ddrecon.scene_file.choices import may_change
from ddrecon.scene_file.load import SceneFile, read_referenced
from ddrecon.scene_file.problems import Problems
from ddrecon.scene_file.schema import (
    AmbientSection,
    Color,
    DirectionalSection,
    PointSection,
)


def build_lights(scene_file: SceneFile, dtype: torch.dtype, device: torch.device) -> list[Light]:
    """The scene's lights in `dtype` on `device`.

    Raises SceneError or FormatError with the problems of all.
    """
    problems, lights = Problems(), list[Light]()
    for index in range(len(scene_file.tree.lights)):
        with problems.collecting():
            lights.append(_build_light(scene_file, index, dtype, device))
    problems.raise_any()
    return lights


def _build_light(
    scene_file: SceneFile, index: int, dtype: torch.dtype, device: torch.device
) -> Light:
    section = scene_file.tree.lights[index]

    def tensor(value: Color) -> Tensor:
        return torch.tensor(value, dtype=dtype, device=device)

    def color(value: Color) -> Tensor:
        """[1] or [3]"""
        return tensor(value).view(-1)

    if isinstance(section, DirectionalSection):
        return DirectionalLight(tensor(section.direction), color(section.irradiance))
    if isinstance(section, AmbientSection):
        return AmbientLight(color(section.radiance))
    if isinstance(section, PointSection):
        return PointLight(tensor(section.position), color(section.intensity))
    pixels = read_referenced(scene_file, f"lights.{index}.file", section.file, _read_map)
    is_gray = bool((pixels == pixels[..., :1]).all())
    if is_gray and not may_change(scene_file.tree, f"lights.{index}.radiance"):
        pixels = pixels[..., :1]
    radiance = torch.from_numpy(pixels).permute(2, 0, 1).contiguous().to(device, dtype)
    numbers = tensor(section.scale), tensor(section.rotation)
    return EnvironmentLight(radiance, *numbers, section.directions, section.up)


def _read_map(path: Path) -> np.ndarray:
    """The radiance of an environment map, float32 [h, w, 3].

    What is negative, as around a sun in lossy files, becomes 0 with a warning.
    """
    pixels = read_image(path).pixels
    height, width = pixels.shape[:2]
    if height < 2 or width < 3:
        raise FormatError(
            path, f"an environment map has at least 3 x 2 pixels, and this is {width} x {height}"
        )
    is_negative = pixels.min(axis=2) < 0
    if negative := np.count_nonzero(is_negative):
        row, column = np.argwhere(is_negative)[0]
        warnings.warn(
            f"{path}: {negative} pixels with negative radiance are taken as 0,"
            f" the first at row {row}, column {column}",
            DataWarning,
            4,
        )
    return pixels.clip(min=0)
