"""The volume section as tensors: density, cross sections and phase function of each medium."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.errors import FormatError
from ddrecon.grid import Grid
from ddrecon.io.volumes.field import Field
from ddrecon.io.volumes.table import read_field
from ddrecon.medium.coefficients import Volume
from ddrecon.medium.mixture import mix_media
from ddrecon.medium.phase import PhaseFunction
from ddrecon.medium.phase_blend import Blend
from ddrecon.memory import Needs, count_threads, make_room
from ddrecon.numerics.harmonics import count_harmonics
from ddrecon.scene_file.agree import agree_on_grid
from ddrecon.scene_file.build_phase import build_phase
from ddrecon.scene_file.files import read_referenced
from ddrecon.scene_file.light_schema import Color
from ddrecon.scene_file.load import SceneFile
from ddrecon.scene_file.phase_schema import (
    BlendSection,
    HenyeyGreensteinSection,
    TwoLobeSection,
)
from ddrecon.scene_file.problems import Problems
from ddrecon.scene_file.rounds import choose_rounds
from ddrecon.scene_file.schema import AnyVolume, MediumSection, VolumeSection
from ddrecon.settings import FieldFile, ParameterSettings
from ddrecon.variables.kinds import FIELDS, PHASE, kind_of, split_name
from ddrecon.variables.values import cross_sections

Fields = Mapping[str, Field]
_BY_ANGLE = "g", "phase.weight"
"""Quantities that belong to the phase function."""


def build_volume(scene_file: SceneFile, dtype: torch.dtype, device: torch.device) -> Volume:
    """The volume of the scene in `dtype` on `device`.

    Raises SceneError with all its problems, or FormatError.
    """
    fields = _read_fields(scene_file)
    keys = {name: f"{key}.file" for name, (key, _) in _quantities(scene_file.tree.volume).items()}
    grid = agree_on_grid(scene_file, {keys[name]: field for name, field in fields.items()})
    media = {
        medium: _Medium(section, {name: fields[medium + name] for name in _names(medium, fields)})
        for medium, section in _media(scene_file.tree.volume).items()
    }
    phases = {
        medium: build_phase(
            scene_file, each.section, f"volume.{medium}".strip("."), each.cells, dtype, device
        )
        for medium, each in media.items()
    }
    if too_much := make_room(_needs(scene_file, media, grid, phases, dtype, device), device):
        raise scene_file.refused("volume.resolution", too_much)
    volumes = {
        medium.removeprefix("media.").strip("."): each.build(grid, phases[medium], dtype, device)
        for medium, each in media.items()
    }
    return volumes[""] if "" in volumes else mix_media(volumes)


@dataclass(frozen=True)
class _Medium:
    """What the scene says of one medium, and the `fields` of its files by variable."""

    section: VolumeSection | MediumSection
    fields: Fields

    @property
    def cells(self) -> Tensor | None:
        """The number of the phase function that a file gives cell by cell."""
        names = (name for name in _BY_ANGLE if name in self.fields)
        return next((_channels_first(self.fields[name]) for name in names), None)

    @property
    def has_colors(self) -> bool:
        """Whether one of its quantities differs by color."""
        given = _quantities_of(self.section).items()
        return any(
            self.fields[name].values.ndim == 4 if name in self.fields else isinstance(value, tuple)
            for name, (_, value) in given
        )

    def build(
        self, grid: Grid, phase: PhaseFunction, dtype: torch.dtype, device: torch.device
    ) -> Volume:
        """The medium as tensors."""
        if self.section.sigma_t is None:
            sigma_a, sigma_s = self._quantity("sigma_a"), self._quantity("sigma_s")
        else:
            sigma_a, sigma_s = cross_sections(self._quantity("sigma_t"), self._quantity("albedo"))
        sigma_a, sigma_s = _same_colors(sigma_a, sigma_s)
        if phase.colors > 1:
            sigma_a, sigma_s = (sigma.expand(3, *sigma.shape[1:]) for sigma in (sigma_a, sigma_s))
        density = self._quantity("density")
        density = (
            density[0] if density.ndim == 4 else torch.full(grid.shape, density.item(), dtype=dtype)
        )
        density, sigma_a, sigma_s = (
            tensor.to(device, dtype) for tensor in (density, sigma_a, sigma_s)
        )
        return Volume(grid, density, sigma_a, sigma_s, phase)

    def _quantity(self, name: str) -> Tensor:
        if name in self.fields:
            return _channels_first(self.fields[name])
        value: Color = getattr(self.section, name)
        return torch.tensor([value] if isinstance(value, float) else value, dtype=torch.float64)


def _media(volume: AnyVolume) -> dict[str, VolumeSection | MediumSection]:
    """The sections of media, by what names of their variables begin with."""
    if isinstance(volume, VolumeSection):
        return {"": volume}
    return {f"media.{name}.": section for name, section in volume.media.items()}


def _names(medium: str, fields: Fields) -> list[str]:
    """The names of those `fields` that are of one `medium`, within it."""
    split = map(split_name, fields)
    return [name for of, name in split if of == medium]


def _needs(
    scene_file: SceneFile,
    media: Mapping[str, _Medium],
    grid: Grid,
    phases: Mapping[str, PhaseFunction],
    dtype: torch.dtype,
    device: torch.device,
) -> Needs:
    """What the scene's memory depends on.

    Views that are as large as their images count as nothing, since those are not read yet.
    """
    tree = scene_file.tree
    colors = 3 if any(medium.has_colors for medium in media.values()) else 1
    optimized = tree.optimize.parameters if tree.optimize else {}
    sizes = [view.camera.resolution for view in tree.views if view.camera.resolution is not None]
    first, *others = phases.values()
    phase = Blend(first, others[0], torch.tensor(0.5, dtype=dtype)) if others else first
    has_flux = "g" in optimized or any(
        medium.section.g != 0 or medium.section.phase is not None for medium in media.values()
    )
    return Needs(
        (grid.shape[2], grid.shape[1], grid.shape[0]),
        colors,
        torch.finfo(dtype).bits // 8,
        sum(width * height for width, height in sizes),
        has_flux=has_flux,
        has_rounds=tree.diffusion.rounds > 0,
        moments=count_harmonics(choose_rounds(tree, phase).angles) if has_flux else 1,
        is_limited=tree.diffusion.model == "flux_limited",
        varied=sum(_varied(name, settings, media, colors) for name, settings in optimized.items())
        if tree.optimize
        else None,
        lights=len(tree.lights),
        threads=count_threads(device),
    )


def _varied(
    name: str, settings: ParameterSettings, media: Mapping[str, _Medium], colors: int
) -> int:
    """How many numbers a cell the parameter `name` has."""
    medium, last = split_name(name)
    kind = kind_of(name)
    if last == "density":
        return 1
    is_field = (
        (medium in media and last in media[medium].fields) or isinstance(settings.init, FieldFile)
        if settings.field is None
        else settings.field
    )
    return (colors if kind.is_color else 1) if kind.is_cellwise and is_field else 0


def _read_fields(scene_file: SceneFile) -> Fields:
    problems, fields = Problems(), {}
    for name, (key, value) in _quantities(scene_file.tree.volume).items():
        if isinstance(value, FieldFile):
            called = value.name or split_name(name)[1].removeprefix(PHASE)
            with problems.collecting():
                fields[name] = read_referenced(
                    scene_file,
                    f"{key}.file",
                    value.file,
                    partial(_read_quantity, name=name, called=called),
                )
    problems.raise_any()
    return fields


def _quantities(volume: AnyVolume) -> dict[str, tuple[str, Any]]:
    """The key and the value of each quantity that a file may give cell by cell, by variable."""
    return {
        medium + name: (f"volume.{medium}{key}", value)
        for medium, section in _media(volume).items()
        for name, (key, value) in _quantities_of(section).items()
    }


def _quantities_of(section: VolumeSection | MediumSection) -> dict[str, tuple[str, Any]]:
    """The same of one medium."""
    found = {name: (name, getattr(section, name)) for name in FIELDS if hasattr(section, name)}
    if isinstance(section.phase, HenyeyGreensteinSection):
        found["g"] = "phase.g", section.phase.g
    elif isinstance(section.phase, TwoLobeSection | BlendSection):
        found["phase.weight"] = "phase.weight", section.phase.weight
    return found


def _read_quantity(path: Path, name: str, called: str) -> Field:
    """The quantity `name`, which the file has as `called`."""
    field = read_field(path, called)
    kind = kind_of(name)
    if not kind.is_color and field.values.ndim != 3:
        raise FormatError(
            path,
            f"{called} has shape {list(field.values.shape)}; expected [z, y, x]:"
            " colors belong to the cross sections",
        )
    for bound, is_beyond, side in (
        (kind.low, field.values < np.float32(kind.low), "below"),
        (kind.high, field.values > np.float32(kind.high), "above"),
    ):
        if is_beyond.any():
            z, y, x = np.argwhere(is_beyond)[0, :3]
            worst = field.values.min() if side == "below" else field.values.max()
            raise FormatError(
                path,
                f"{called} is {side} {bound:g} at cell (x, y, z) = ({x}, {y}, {z}) "
                f"(the {'lowest' if side == 'below' else 'highest'} is {worst:g})",
            )
    return field


def _channels_first(field: Field) -> Tensor:
    """The field as float64 [C, z, y, x], with C = 1 or 3."""
    values = torch.from_numpy(field.values).double()
    return values[None] if values.ndim == 3 else values.permute(3, 0, 1, 2).contiguous()


def _same_colors(one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
    """Both with as many colors as the more colorful."""
    colors = max(one.shape[0], other.shape[0])
    wide_one, wide_other = (
        tensor.expand(colors, *tensor.shape[1:]).contiguous() for tensor in (one, other)
    )
    return wide_one, wide_other
