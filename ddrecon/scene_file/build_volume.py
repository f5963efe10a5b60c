"""The volume section as tensors: density, cross sections and phase function of each medium."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.errors import DataWarning, FormatError, Problems, SceneError, UsageError, gather
from ddrecon.grid import Grid
from ddrecon.io.phase_files import read_phase_table
from ddrecon.io.volumes.field import GRAMS, KELVIN, MICROMETERS, Field, size_of
from ddrecon.io.volumes.table import read_field
from ddrecon.medium.coefficients import Volume
from ddrecon.medium.optics import black_body_radiance, scatter_droplets
from ddrecon.medium.phase import (
    Blend,
    HenyeyGreenstein,
    PhaseFunction,
    Rayleigh,
    Tabulated,
    TwoLobe,
)
from ddrecon.numerics.series import at_even_angles
from ddrecon.scene_file import schema
from ddrecon.scene_file.build_views import Maker
from ddrecon.scene_file.load import SceneFile, read_referenced
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


def build_media(maker: Maker) -> dict[str, Volume]:
    """The media of the scene by name, "" where there is one.

    A density that is the same everywhere takes no memory yet. Raises SceneError with all their
    problems, or FormatError.
    """
    media = {
        name: _Medium(maker, f"media.{name}." if name else "", section)
        for name, section in maker.tree.media.items()
    }
    gather(_Medium.read_fields, media.values())
    fields = dict(entry for medium in media.values() for entry in medium.fields.values())
    grid = _agree_on_grid(maker.scene_file, fields)
    gather(lambda medium: medium.spread_heights(grid), media.values())
    return {name: medium.build(grid) for name, medium in media.items()}


class _Medium:
    """What a scene says in `section` of a medium, names in which begin with `prefix`.

    `quantities` may differ from cell to cell: by variable, the key in `section` and the value.
    `fields` are those that do, with the key at which the scene names them.
    """

    def __init__(self, maker: Maker, prefix: str, section: schema.MediumSection):
        self.maker, self.prefix, self.section = maker, prefix, section
        self.fields: dict[str, tuple[str, Field]] = {}
        self.quantities: dict[str, tuple[str, Any]] = {
            name: (name, getattr(section, name))
            for name in (*FIELDS, "temperature")
            if hasattr(section, name)
        }
        match phase := section.phase:
            case schema.HenyeyGreensteinSection():
                self.quantities["g"] = "phase.g", phase.g
            case schema.TwoLobeSection():
                self.quantities["phase.weight"] = "phase.weight", phase.weight
            case schema.MieSection():
                by_cell = getattr(section, RADIUS, None)
                radius = phase.effective_radius if by_cell is None else by_cell
                self.quantities[RADIUS] = RADIUS, radius

    def refused(self, key: str, fault: str) -> SceneError:
        """The error that says what is wrong at `key` of the medium."""
        return self.maker.scene_file.refused(f"volume.{self.prefix}{key}", fault)

    def read_fields(self) -> None:
        """Reads the quantities that files give cell by cell; raises SceneError or FormatError."""
        kinds = FieldFile | schema.ByLabel
        files = [name for name, (_, value) in self.quantities.items() if isinstance(value, kinds)]
        self.fields |= dict(zip(files, gather(self.read_field, files), strict=True))

    def read_field(self, variable: str) -> tuple[str, Field]:
        """The key at which the scene names the file of `variable`, and its content."""
        water, (name, value) = self.section.sigma_t, self.quantities[variable]
        key = f"volume.{self.prefix}{name}"
        if isinstance(value, schema.ByLabel):
            read = partial(read_field, name=value.name)
            labels = read_referenced(self.maker.scene_file, f"{key}.labels", value.labels, read)
            return f"{key}.labels", self.look_up(variable, f"{name}.table", value, labels)
        called = value.name or variable.removeprefix(PHASE)
        is_free = variable == "density" and not isinstance(water, schema.Water)
        unit = None if is_free else UNITS.get(variable)
        read = partial(read_quantity, name=_kind_name(variable), called=called, unit=unit)
        field = read_referenced(self.maker.scene_file, f"{key}.file", value.file, read)
        if isinstance(water, schema.Water) and field.meters not in (None, water.meters):
            fault = f"but u of {value.file.name} has {field.meters:g} m"
            raise self.refused("sigma_t.meters", f"is {water.meters:g}, {fault}")
        return f"{key}.file", field

    def look_up(self, variable: str, key: str, by_label: schema.ByLabel, field: Field) -> Field:
        """`variable` in each cell by the table at `key`, of which `field` has the labels."""
        table = self.table_of(variable, key, by_label.table)
        labels = field.values.astype(np.int64)
        if field.values.ndim != 3 or (labels != field.values).any() or labels.min() < 0:
            fault = f"{by_label.name} are not whole numbers from 0, one a cell"
            raise FormatError(by_label.labels, fault)
        if labels.max() >= len(table):
            fault = f"expected one for each label, {labels.max() + 1} with 0, found {len(table)}"
            raise self.refused(key, fault)
        return replace(field, values=table[labels].astype(np.float32))

    def table_of(self, variable: str, key: str, rows: Sequence[Any]) -> np.ndarray:
        """The `rows` of `variable` at `key`, numbers [n] or colors [n, 3]; else SceneError."""
        kind, colors = kind_of(_kind_name(variable)), [np.ravel(row) for row in rows]
        if not kind.is_color and max(map(len, colors)) > 1:
            raise self.refused(key, "expected numbers: colors belong to the cross sections")
        table = np.stack(np.broadcast_arrays(*colors))
        if not kind.allows(torch.from_numpy(table)):
            raise self.refused(key, f"must be {kind.limits}")
        return table.squeeze(1) if table.shape[1] == 1 else table

    def spread_heights(self, grid: Grid) -> None:
        """Evaluates the quantities that are given by height at the centers of cells of `grid`."""
        axis = "zyx".index(self.maker.tree.volume.up)
        centers = grid.lower[axis] + grid.spacing[axis] * (np.arange(grid.shape[axis]) + 0.5)
        for variable, (name, value) in self.quantities.items():
            if isinstance(value, schema.ByHeight):
                key = f"{name}.values"
                table = self.table_of(variable, key, value.values)
                colors = [
                    np.interp(centers, value.heights, color) for color in np.atleast_2d(table.T)
                ]
                column = np.stack(colors, -1) if table.ndim == 2 else colors[0]
                ahead = column[(slice(None), *[None] * (2 - axis))]
                cells = np.broadcast_to(ahead, (*grid.shape, *column.shape[1:])).copy()
                self.fields[variable] = f"volume.{self.prefix}{key}", Field(cells)

    def values(self, name: str) -> Tensor:
        """The quantity `name`, float64 [C] or [C, z, y, x]."""
        if name in self.fields:
            return cells_of(self.fields[name][1]).double()
        value = self.quantities[name][1]
        if isinstance(value, schema.Water):
            radius = self.values(RADIUS)
            return torch.where(radius > 0, EXTINCTION * value.meters / radius, 0.0)
        value = self.maker.tree.share_color(self.prefix + name, value)
        return torch.tensor(value, dtype=torch.float64).view(-1)

    def build(self, grid: Grid) -> Volume:
        """The medium as tensors."""
        section, tensor, phase = self.section, self.maker.tensor, self.build_phase()
        if section.sigma_t is None:
            sigmas = self.values("sigma_a"), self.values("sigma_s")
        else:
            sigmas = cross_sections(self.values("sigma_t"), self.values("albedo"))
        colors = max(*map(len, sigmas), phase.colors)
        sigma_a, sigma_s = (
            tensor(sigma.expand(colors, *sigma.shape[1:]).contiguous()) for sigma in sigmas
        )
        density = tensor(self.values("density"))[0].expand(grid.shape)
        medium = Volume(grid, density, sigma_a, sigma_s, phase)
        medium.index = getattr(section, "index", 1.0)
        if isinstance(section, schema.VolumeSection) and self.maker.tree.glows:
            if section.temperature is not None:
                medium.black_body = tensor(black_body_radiance(self.values("temperature")[0]))
            else:
                medium.emission = tensor(
                    sigma_a.new_zeros(3) if section.emission is None else self.values("emission")
                )
        return medium

    def build_phase(self) -> PhaseFunction:
        """The phase function; MissingExtraError for droplets without miepython."""
        match section := self.section.phase:
            case None | schema.HenyeyGreensteinSection():
                return HenyeyGreenstein(self.number("g"))
            case schema.TwoLobeSection():
                return TwoLobe(self.maker.tensor(section.g), self.number("phase.weight"))
            case schema.TableSection():
                return Tabulated(self.maker.tensor(self.read_table(section)))
            case schema.RayleighSection():
                return Rayleigh(self.maker.tensor(0.0))
        radius = self.values(RADIUS).squeeze(0)
        known = radius[radius > 0]
        if not len(known) or known.max() > 100:
            fault = f"must be above 0 somewhere and at most 100, found {float(radius.max()):g}"
            raise self.refused(RADIUS, fault)
        least, most = float(known.min()), float(known.max())
        smallest = Tabulated(self.maker.tensor(_scatter(section, least)))
        if least == most:
            return smallest
        largest = Tabulated(self.maker.tensor(_scatter(section, most)))
        # Where there are none, as large as elsewhere in the mean.
        inverse = 1 / torch.where(radius > 0, radius, known.mean())
        weight = (inverse - 1 / most) / (1 / least - 1 / most)
        return Blend(smallest, largest, self.maker.tensor(weight))

    def number(self, name: str) -> Tensor:
        """The number `name` of a phase function: [], a color [3], or a field."""
        if name in self.fields:
            return self.maker.tensor(self.values(name))
        value = self.quantities[name][1]
        return self.maker.tensor(self.maker.tree.share_color(self.prefix + name, value))

    def read_table(self, section: schema.TableSection) -> Tensor:
        """Values at even angles, [C, steps + 1]."""
        key = f"volume.{self.prefix}phase.file"
        table = read_referenced(self.maker.scene_file, key, section.file, read_phase_table)
        values = torch.from_numpy(at_even_angles(*table))
        means = Tabulated(values).mean
        if bool(((means - 1).abs() > FAR_OFF).any()):
            words = ", ".join(f"{mean:.4g}" for mean in means.tolist())
            fault = f"its mean over the sphere is {words}; it is divided by that"
            warnings.warn(f"{section.file}: {fault}", DataWarning, 4)
        return values


def _kind_name(variable: str) -> str:
    """The variable whose kind `variable` is: density's, one number a cell, where it is none."""
    return variable if variable in FIELDS else "density"


def _scatter(section: schema.MieSection, radius: float) -> np.ndarray:
    """Values at even angles of droplets of this effective radius, [C, steps + 1]."""
    colors = np.broadcast(np.atleast_1d(section.wavelength), section.refractive_index)
    sizes = radius, section.effective_variance
    return np.stack([scatter_droplets(float(length), float(n), *sizes) for length, n in colors])


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
        fault = f"{called} is {side} at cell (x, y, z) = ({x}, {y}, {z}): {field.values[place]:g}"
        raise FormatError(path, fault)
    return field


def _agree_on_grid(scene_file: SceneFile, fields: Mapping[str, Field]) -> Grid:
    """The grid of the scene and of all `fields` of its files, which are by key.

    Raises SceneError with all that do not agree, or where nothing says what the grid is.
    """
    section, problems = scene_file.tree.volume, Problems()
    box, size = None, section.resolution if isinstance(section.resolution, tuple) else None
    if isinstance(section.bounds, schema.Bounds):
        box = np.array([section.bounds.min, section.bounds.max])
    sizes = {"volume.resolution": size} | {key: field.resolution for key, field in fields.items()}
    boxes = {"volume.bounds": box} | {key: field.bounds for key, field in fields.items()}
    for word, values in (("resolution", sizes), ("bounds", boxes)):
        known = {key: np.array(value) for key, value in values.items() if value is not None}
        if not known:
            fault = f"missing key {word!r}, which no field file gives either"
            problems.note(scene_file.refused("volume", fault))
            continue
        first, right = next(iter(known.items()))
        # Files may hold bounds in single precision.
        tolerance = 1e-5 * np.ptp(right, axis=0) if word == "bounds" else 0
        for key, value in known.items():
            if (np.abs(value - right) > tolerance).any():
                fault = f"has the {word} {_show(value)}, but {first} has {_show(right)}"
                problems.note(scene_file.refused(key, fault))
    problems.raise_any()
    size = next(size for size in sizes.values() if size is not None)
    low, high = next(box for box in boxes.values() if box is not None).tolist()
    try:
        return Grid.from_xyz(size, tuple(low), tuple(high), "".join(section.periodic))
    except UsageError as error:
        raise scene_file.refused(*str(error).split(": ", 1)) from None


def _show(value: np.ndarray) -> str:
    """A resolution or a box in words."""
    if value.ndim == 1:
        return " x ".join(map(str, value))
    return " to ".join(f"({', '.join(f'{side:g}' for side in corner)})" for corner in value)
