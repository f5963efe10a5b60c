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
from ddrecon.io.volumes.units import GRAMS, KELVIN, MICROMETERS, size_of
from ddrecon.medium.black_body import black_body_radiance
from ddrecon.medium.coefficients import Volume
from ddrecon.medium.mie import scatter_droplets
from ddrecon.medium.phase import HenyeyGreenstein, PhaseFunction, Rayleigh
from ddrecon.medium.phase_blend import Blend, TwoLobe
from ddrecon.medium.phase_series import Tabulated
from ddrecon.numerics.angle_table import at_even_angles
from ddrecon.scene_file.load import SceneFile, read_referenced
from ddrecon.scene_file.schema import (
    Bounds,
    HenyeyGreensteinSection,
    MediumSection,
    MieSection,
    Profile,
    SceneTree,
    TableSection,
    TwoLobeSection,
    Water,
)
from ddrecon.settings import FieldFile
from ddrecon.variables.kinds import FIELDS, PHASE, kind_of
from ddrecon.variables.values import cross_sections

RADIUS = "effective_radius"
EXTINCTION = 1.5
"""Of 1 g/m3 of droplets with an effective radius of 1 micrometer [1/m]: 3 Q / (4 rho r), Q = 2."""
UNITS = {
    "density": ("g/m3, which sigma_t: {meters: ...} takes (kg/kg times air's density)", GRAMS),
    RADIUS: ("micrometers", MICROMETERS),
    "temperature": ("kelvin", KELVIN),
}
"""What is expected in a unit: its name, and the spellings of its multiples in files."""
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
    for each in media.values():
        with problems.collecting():
            each.fields.update(_spread_profiles(scene_file, each, grid))
    problems.raise_any()
    return {
        name: each.build(grid, _build_phase(scene_file, each, dtype, device), dtype, device)
        for name, each in media.items()
    }


@dataclass(frozen=True)
class _Medium:
    """What the scene `tree` says of a medium, names in which begin with `prefix`.

    `fields` are those of its files and profiles by variable, and where the scene names them.
    """

    tree: SceneTree
    prefix: str
    section: MediumSection
    fields: dict[str, tuple[str, Field]]

    def values(self, name: str) -> Tensor:
        """The quantity `name`, float64 [C] or [C, z, y, x]."""
        if name in self.fields:
            return cells_of(self.fields[name][1]).double()
        value = _quantities(self.section)[name][1]
        if isinstance(value, Water):
            radius = self.values(RADIUS)
            return torch.where(radius > 0, EXTINCTION * value.meters / radius, 0.0)
        value = self.tree.share_color(self.prefix + name, value)
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
        if self.tree.glows and getattr(self.section, "temperature", None) is not None:
            black_body = black_body_radiance(self.values("temperature")[0]).to(device, dtype)
        elif self.tree.glows and getattr(self.section, "emission", None) is not None:
            emission = self.values("emission").to(device, dtype)
        elif not self.prefix and self.tree.may_change("emission"):
            emission = sigma_a.new_zeros(3)
        medium = Volume(grid, density, sigma_a, sigma_s, phase)
        index = getattr(self.section, "index", 1.0)
        return replace(medium, emission=emission, black_body=black_body, index=index)


def _read_fields(
    scene_file: SceneFile, prefix: str, section: MediumSection
) -> dict[str, tuple[str, Field]]:
    """The quantities that files give cell by cell, by variable; and where the scene says so."""
    problems, found = Problems(), {}
    for variable, (name, value) in _quantities(section).items():
        if isinstance(value, FieldFile):
            called = value.name or variable.removeprefix(PHASE)
            is_free = variable == "density" and not isinstance(section.sigma_t, Water)
            unit = None if is_free else UNITS.get(variable)
            read = partial(read_quantity, name=_kind_name(variable), called=called, unit=unit)
            with problems.collecting():
                at = f"volume.{prefix}{name}.file"
                field = read_referenced(scene_file, at, value.file, read)
                found[variable] = at, field
                if isinstance(section.sigma_t, Water):
                    said = section.sigma_t.meters
                    if field.meters not in (None, said):
                        what = f"is {said:g}, but u of {value.file.name} has {field.meters:g} m"
                        raise scene_file.refused(f"volume.{prefix}sigma_t.meters", what)
    problems.raise_any()
    return found


def _quantities(section: MediumSection) -> dict[str, tuple[str, Any]]:
    """What may differ from cell to cell, by variable: its key in `section`, and its value."""
    names = (name for name in (*FIELDS, "temperature") if hasattr(section, name))
    given = {name: (name, getattr(section, name)) for name in names}
    if isinstance(section.phase, HenyeyGreensteinSection):
        given["g"] = "phase.g", section.phase.g
    elif isinstance(section.phase, TwoLobeSection):
        given["phase.weight"] = "phase.weight", section.phase.weight
    elif isinstance(section.phase, MieSection):
        by_cell, same = getattr(section, RADIUS, None), section.phase.effective_radius
        given[RADIUS] = RADIUS, same if by_cell is None else by_cell
    return given


def _kind_name(variable: str) -> str:
    """That of its kind: of others than variables that of density, a number a cell, none below 0."""
    return variable if variable in FIELDS else "density"


def _spread_profiles(
    scene_file: SceneFile, medium: _Medium, grid: Grid
) -> dict[str, tuple[str, Field]]:
    """The quantities that `medium` has by height, at the centers of the cells of `grid`."""
    axis, found = "zyx".index(scene_file.tree.volume.up), {}
    low, size = grid.lower[axis], grid.spacing[axis]
    centers = low + size * (np.arange(grid.shape[axis]) + 0.5)
    for variable, (name, value) in _quantities(medium.section).items():
        if not isinstance(value, Profile):
            continue
        at, kind = f"volume.{medium.prefix}{name}.values", kind_of(_kind_name(variable))
        colors = [np.ravel(one) for one in value.values]
        if not kind.is_color and max(map(len, colors)) > 1:
            raise scene_file.refused(at, "expected numbers: colors belong to the cross sections")
        if not all(((kind.low <= one) & (one <= kind.high)).all() for one in colors):
            limits = f"at least {kind.low:g} and at most {kind.high:g}"
            raise scene_file.refused(at, f"must be {limits}")
        known = np.stack(np.broadcast_arrays(*colors), 1)
        column = np.stack([np.interp(centers, value.heights, one) for one in known], -1)
        level = [size for other, size in enumerate(grid.shape) if other != axis]
        cells = np.moveaxis(np.broadcast_to(column, (*level, *column.shape)), 2, axis).copy()
        found[variable] = at, Field(cells[..., 0] if len(known) == 1 else cells)
    return found


def cells_of(field: Field) -> Tensor:
    """The values [C, z, y, x] of `field`."""
    values = torch.from_numpy(field.values)
    return values[None] if values.ndim == 3 else values.permute(3, 0, 1, 2).contiguous()


def read_quantity(
    path: Path, name: str, called: str, unit: tuple[str, Mapping[str, float]] | None = None
) -> Field:
    """The quantity `name`, which the file has as `called`, in this `unit`; raises FormatError."""
    field, kind = read_field(path, called), kind_of(name)
    if unit and field.unit == "":
        warnings.warn(f"{path}: {called} says no unit; taken in {unit[0]}", DataWarning, 2)
    elif unit and field.unit:
        size = size_of(field.unit, unit[1])
        if size is None:
            raise FormatError(path, f"{called} is in {field.unit}, not {unit[0]}; convert it first")
        field = replace(field, values=field.values * np.float32(size))
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
    box, size = None, section.resolution if isinstance(section.resolution, tuple) else None
    if isinstance(section.bounds, Bounds):
        box = np.array([section.bounds.min, section.bounds.max])
    sizes = {"volume.resolution": size} | {key: field.resolution for key, field in fields.items()}
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
        if isinstance(value, FieldFile | Profile):
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
            radius = medium.values(RADIUS).squeeze(0)
            known = radius[radius > 0]
            if not len(known) or known.max() > 100:
                what = f"must be above 0 somewhere and at most 100, found {float(radius.max()):g}"
                raise scene_file.refused(f"volume.{medium.prefix}{RADIUS}", what)
            least, most = float(known.min()), float(known.max())
            smallest = Tabulated(tensor(_droplets(section, least)))
            if least == most:
                return smallest
            # Where there are none, as large as elsewhere in the mean.
            inverse = 1 / torch.where(radius > 0, radius, known.mean())
            weight = tensor((inverse - 1 / most) / (1 / least - 1 / most))
            return Blend(smallest, Tabulated(tensor(_droplets(section, most))), weight)
    return Rayleigh(tensor(0.0))


def _droplets(section: MieSection, radius: float) -> np.ndarray:
    """Values at even angles, [C, steps + 1]."""
    colors = np.broadcast(np.atleast_1d(section.wavelength), section.refractive_index)
    sizes = radius, section.effective_variance
    return np.stack([scatter_droplets(float(length), float(n), *sizes) for length, n in colors])


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
