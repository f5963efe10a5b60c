"""The volume section as tensors: density, cross sections and phase function of each medium."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.errors import DataWarning, FormatError, Problems
from ddrecon.grid import Grid
from ddrecon.io.phase_files import read_phase_table
from ddrecon.io.volumes.field import Field
from ddrecon.io.volumes.table import read_field
from ddrecon.medium.black_body import black_body_radiance
from ddrecon.medium.coefficients import Volume
from ddrecon.medium.mie import scatter_droplets
from ddrecon.medium.phase import HenyeyGreenstein, PhaseFunction, Rayleigh
from ddrecon.medium.phase_blend import TwoLobe
from ddrecon.medium.phase_series import Tabulated
from ddrecon.numerics.angle_table import at_even_angles
from ddrecon.scene_file.load import SceneFile, read_referenced
from ddrecon.scene_file.schema import (
    HenyeyGreensteinSection,
    MediumSection,
    MieSection,
    SceneTree,
    TableSection,
    TwoLobeSection,
)
from ddrecon.settings import FieldFile
from ddrecon.variables.kinds import FIELDS, PHASE, kind_of
from ddrecon.variables.values import cross_sections

FAR_OFF = 0.01
"""A table whose mean over the sphere is further from 1 is not normalized, and the user is told."""


def build_media(
    scene_file: SceneFile, dtype: torch.dtype, device: torch.device
) -> dict[str, Volume]:
    """The media of the scene in `dtype` on `device`, by name, "" where there is one.

    A density that is the same everywhere takes no memory yet. Raises SceneError with all their
    problems, or FormatError.
    """
    media, problems = dict[str, _Medium](), Problems()
    for name, section in scene_file.tree.media.items():
        prefix = f"media.{name}." if name else ""
        with problems.collecting():
            fields = _read_fields(scene_file, prefix, section)
            media[name] = _Medium(scene_file.tree, prefix, section, fields)
    problems.raise_any()
    grid = _agree_on_grid(
        scene_file, dict(at for each in media.values() for at in each.fields.values())
    )
    return {
        name: each.build(grid, _build_phase(scene_file, each, dtype, device), dtype, device)
        for name, each in media.items()
    }


@dataclass(frozen=True)
class _Medium:
    """What the scene `tree` says of a medium, names in which begin with `prefix`.

    `fields` are those of its files by variable, and where the scene names them.
    """

    tree: SceneTree
    prefix: str
    section: MediumSection
    fields: Mapping[str, tuple[str, Field]]

    def values(self, name: str) -> Tensor:
        """The quantity `name`, float64 [C] or [C, z, y, x]."""
        if name in self.fields:
            return cells_of(self.fields[name][1]).double()
        value = self.tree.share_color(self.prefix + name, getattr(self.section, name))
        return torch.tensor(value, dtype=torch.float64).view(-1)

    def build(
        self, grid: Grid, phase: PhaseFunction, dtype: torch.dtype, device: torch.device
    ) -> Volume:
        """The medium as tensors."""
        if self.section.sigma_t is None:
            sigmas = self.values("sigma_a"), self.values("sigma_s")
        else:
            sigmas = cross_sections(self.values("sigma_t"), self.values("albedo"))
        colors = max(*map(len, sigmas), phase.colors)
        sigma_a, sigma_s = (
            sigma.expand(colors, *sigma.shape[1:]).contiguous().to(device, dtype)
            for sigma in sigmas
        )
        density = self.values("density").to(device, dtype)[0].expand(grid.shape)
        emission = black_body = None
        if getattr(self.section, "temperature", None) is not None:
            black_body = black_body_radiance(self.values("temperature")[0]).to(device, dtype)
        elif getattr(self.section, "emission", None) is not None:
            emission = self.values("emission").to(device, dtype)
        elif self.tree.may_change(self.prefix + "emission"):
            emission = sigma_a.new_zeros(3)
        medium = Volume(grid, density, sigma_a, sigma_s, phase)
        return replace(medium, emission=emission, black_body=black_body)


def _read_fields(
    scene_file: SceneFile, prefix: str, section: MediumSection
) -> dict[str, tuple[str, Field]]:
    """The quantities that files give cell by cell, by variable; and where the scene says so."""
    names = (name for name in (*FIELDS, "temperature") if hasattr(section, name))
    given = {name: (name, getattr(section, name)) for name in names}
    if isinstance(section.phase, HenyeyGreensteinSection):
        given["g"] = "phase.g", section.phase.g
    elif isinstance(section.phase, TwoLobeSection):
        given["phase.weight"] = "phase.weight", section.phase.weight
    problems, found = Problems(), {}
    for variable, (name, value) in given.items():
        if isinstance(value, FieldFile):
            called = value.name or variable.removeprefix(PHASE)
            # A temperature is as a density: one number a cell, none below 0.
            kind = "density" if variable == "temperature" else variable
            read = partial(read_quantity, name=kind, called=called)
            with problems.collecting():
                at = f"volume.{prefix}{name}.file"
                found[variable] = at, read_referenced(scene_file, at, value.file, read)
    problems.raise_any()
    return found


def cells_of(field: Field) -> Tensor:
    """The values [C, z, y, x] of `field`."""
    values = torch.from_numpy(field.values)
    return values[None] if values.ndim == 3 else values.permute(3, 0, 1, 2).contiguous()


def read_quantity(path: Path, name: str, called: str) -> Field:
    """The quantity `name`, which the file has as `called`; raises FormatError."""
    field, kind = read_field(path, called), kind_of(name)
    if not kind.is_color and field.values.ndim != 3:
        raise FormatError(
            path,
            f"{called} has shape {list(field.values.shape)}; expected [z, y, x]:"
            " colors belong to the cross sections",
        )
    low, high = np.float32(kind.low), np.float32(kind.high)
    beyond = (field.values < low) | (field.values > high)
    if beyond.any():
        place = tuple(np.argwhere(beyond)[0])
        side = f"below {low:g}" if field.values[place] < low else f"above {high:g}"
        z, y, x = place[:3]
        what = f"{called} is {side} at cell (x, y, z) = ({x}, {y}, {z}): {field.values[place]:g}"
        raise FormatError(path, what)
    return field


def _agree_on_grid(scene_file: SceneFile, fields: Mapping[str, Field]) -> Grid:
    """The grid of the scene and of all `fields` of its files, which are by key.

    Raises SceneError with all that do not agree, or where nothing says what the grid is.
    """
    section, problems = scene_file.tree.volume, Problems()
    box = None
    if section.bounds is not None:
        box = np.array([section.bounds.min, section.bounds.max])
    sizes = {"volume.resolution": section.resolution} | {k: f.resolution for k, f in fields.items()}
    boxes = {"volume.bounds": box} | {key: field.bounds for key, field in fields.items()}
    for what, given in (("resolution", sizes), ("bounds", boxes)):
        known = {key: np.array(value) for key, value in given.items() if value is not None}
        if not known:
            missing = f"missing key {what!r}, which no field file gives either"
            problems.note(scene_file.refused("volume", missing))
            continue
        first, right = next(iter(known.items()))
        # Files may hold bounds in single precision.
        tolerance = 1e-5 * np.ptp(right, axis=0) if what == "bounds" else 0
        for key, value in known.items():
            if (np.abs(value - right) > tolerance).any():
                words = f"has the {what} {_show(value)}, but {first} has {_show(right)}"
                problems.note(scene_file.refused(key, words))
    problems.raise_any()
    size = next(size for size in sizes.values() if size is not None)
    low, high = next(box for box in boxes.values() if box is not None).tolist()
    return Grid.from_xyz(size, tuple(low), tuple(high), "".join(section.periodic))


def _show(value: np.ndarray) -> str:
    """A resolution or a box in words."""
    if value.ndim == 1:
        return " x ".join(map(str, value))
    return " to ".join(f"({', '.join(f'{side:g}' for side in corner)})" for corner in value)


def _build_phase(
    scene_file: SceneFile, medium: _Medium, dtype: torch.dtype, device: torch.device
) -> PhaseFunction:
    """The phase function of `medium`; MissingExtraError for droplets without miepython."""

    def tensor(value: Any, name: str = "") -> Tensor:
        if isinstance(value, FieldFile):
            return medium.values(name).to(device, dtype)
        value = medium.tree.share_color(f"{medium.prefix}{name}", value)
        return torch.as_tensor(value, dtype=dtype, device=device)

    match section := medium.section.phase:
        case None:
            return HenyeyGreenstein(tensor(medium.section.g, "g"))
        case HenyeyGreensteinSection():
            return HenyeyGreenstein(tensor(section.g, "g"))
        case TwoLobeSection():
            return TwoLobe(tensor(section.g), tensor(section.weight, "phase.weight"))
        case TableSection():
            key = f"volume.{medium.prefix}phase.file"
            return Tabulated(tensor(_table(scene_file, section, key)))
        case MieSection():
            colors = np.broadcast(np.atleast_1d(section.wavelength), section.refractive_index)
            sizes = section.effective_radius, section.effective_variance
            values = [scatter_droplets(float(length), float(n), *sizes) for length, n in colors]
            return Tabulated(tensor(np.stack(values)))
    return Rayleigh(tensor(0.0))


def _table(scene_file: SceneFile, section: TableSection, key: str) -> Tensor:
    """Values at even angles, [C, steps + 1]."""
    read = read_referenced(scene_file, key, section.file, read_phase_table)
    values = torch.from_numpy(at_even_angles(*read))
    means = Tabulated(values).mean
    if bool(((means - 1).abs() > FAR_OFF).any()):
        found = ", ".join(f"{mean:.4g}" for mean in means.tolist())
        what = f"its mean over the sphere is {found}; it is divided by that"
        warnings.warn(f"{section.file}: {what}", DataWarning, 4)
    return values
