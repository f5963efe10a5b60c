"""The phase function of a scene as a record of tensors."""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.errors import DataWarning
from ddrecon.io.phase_files import read_moments, read_phase_table
from ddrecon.medium.mie import scatter_droplets
from ddrecon.medium.phase import Draine, HenyeyGreenstein, PhaseFunction, Rayleigh
from ddrecon.medium.phase_blend import PARTS, Blend, TwoLobe
from ddrecon.medium.phase_series import Legendre, Tabulated
from ddrecon.numerics.angle_table import at_even_angles
from ddrecon.numerics.legendre import COUNTS
from ddrecon.scene_file.files import read_referenced
from ddrecon.scene_file.load import SceneFile
from ddrecon.scene_file.phase_schema import (
    BlendSection,
    Color,
    DraineSection,
    HenyeyGreensteinSection,
    LegendreSection,
    MieSection,
    PhaseSection,
    TableSection,
    TwoLobeSection,
)
from ddrecon.scene_file.schema import MediumSection, VolumeSection
from ddrecon.settings import FieldFile

FAR_OFF = 0.01
"""A table whose mean over the sphere is further from 1 is not normalized, and the user is told."""


def build_phase(
    scene_file: SceneFile,
    volume: VolumeSection | MediumSection,
    key: str,
    cells: Tensor | None,
    dtype: torch.dtype,
    device: torch.device,
) -> PhaseFunction:
    """The phase function of the section `volume` at `key` of the scene, in `dtype` on `device`.

    `cells`: that of its numbers which a file gives cell by cell, [z, y, x] or [C, z, y, x]. Raises
    SceneError, FormatError, or MissingExtraError for droplets without miepython.
    """
    number = partial(torch.tensor, dtype=dtype, device=device)

    def tensor(value: Any) -> Tensor:
        if cells is not None and isinstance(value, FieldFile):
            return cells.to(device, dtype)
        return number(value)

    def build(section: PhaseSection | None, key: str) -> PhaseFunction:
        match section:
            case None:
                return HenyeyGreenstein(tensor(volume.g))
            case HenyeyGreensteinSection():
                return HenyeyGreenstein(tensor(section.g))
            case TwoLobeSection():
                return TwoLobe(tensor(section.g), tensor(section.weight))
            case BlendSection():
                keys = (f"{key}.{PARTS}.{index}" for index in range(2))
                first, second = map(build, section.phases, keys)
                return Blend(first, second, tensor(section.weight))
            case DraineSection():
                return Draine(tensor(section.g), tensor(section.alpha))
            case LegendreSection():
                return Legendre(_moments(scene_file, section, key).to(device, dtype))
            case TableSection():
                return Tabulated(_table(scene_file, section, key).to(device, dtype))
            case MieSection():
                return Tabulated(_droplets(section).to(device, dtype))
        return Rayleigh(tensor(0.0))

    return build(volume.phase, f"{key}.phase")


def _moments(scene_file: SceneFile, section: LegendreSection, key: str) -> Tensor:
    """chi_l from l = 1 on, [n] or [3, n], as many as series have."""
    if section.coefficients is not None:
        return torch.tensor(section.coefficients, dtype=torch.float64)[1 : COUNTS[-1]]
    assert section.file is not None
    moments = read_referenced(scene_file, f"{key}.file", section.file, read_moments)
    return torch.from_numpy(moments[:, 1 : COUNTS[-1]]).squeeze(0)


def _table(scene_file: SceneFile, section: TableSection, key: str) -> Tensor:
    """Values at even angles, [C, steps + 1]."""
    read = read_referenced(scene_file, f"{key}.file", section.file, read_phase_table)
    values = torch.from_numpy(at_even_angles(*read))
    means = Tabulated(values).mean
    if bool(((means - 1).abs() > FAR_OFF).any()):
        found = ", ".join(f"{mean:.4g}" for mean in means.tolist())
        warnings.warn(
            f"{section.file}: its mean over the sphere is {found}; it is divided by that",
            DataWarning,
            4,
        )
    return values


def _droplets(section: MieSection) -> Tensor:
    """Values at even angles of each color, [C, steps + 1]."""
    pairs = zip(*_same_length(section.wavelength, section.refractive_index), strict=True)
    sizes = section.effective_radius, section.effective_variance
    return torch.from_numpy(np.stack([scatter_droplets(*pair, *sizes) for pair in pairs]))


def _same_length(one: Color, other: Color) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Both as so many colors as the more colorful has."""
    wide = [each if isinstance(each, tuple) else (each,) for each in (one, other)]
    count = max(map(len, wide))
    first, second = (each if len(each) == count else each * count for each in wide)
    return first, second
