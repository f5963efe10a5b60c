"""The volume section as tensors: density, cross sections and phase function of each medium."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.errors import DataWarning, FormatError
from ddrecon.grid import Grid, Triple
from ddrecon.io.phase_files import read_phase_table
from ddrecon.io.volumes.field import Field
from ddrecon.io.volumes.table import read_field
from ddrecon.medium.coefficients import Volume
from ddrecon.medium.mie import scatter_droplets
from ddrecon.medium.mixture import mix_media
from ddrecon.medium.phase import HenyeyGreenstein, PhaseFunction, Rayleigh
from ddrecon.medium.phase_blend import Blend, TwoLobe
from ddrecon.medium.phase_series import Tabulated
from ddrecon.memory import make_room, needs_of
from ddrecon.numerics.angle_table import at_even_angles
from ddrecon.scene_file.choices import choose_rounds
from ddrecon.scene_file.load import SceneFile, read_referenced
from ddrecon.scene_file.problems import Problems
from ddrecon.scene_file.schema import (
    Color,
    HenyeyGreensteinSection,
    MediumSection,
    MieSection,
    TableSection,
    TwoLobeSection,
    VolumeSection,
)
from ddrecon.settings import FieldFile, ParameterSettings
from ddrecon.variables.kinds import FIELDS, PHASE, kind_of, split_name
from ddrecon.variables.values import cross_sections

FAR_OFF = 0.01
"""A table whose mean over the sphere is further from 1 is not normalized, and the user is told."""
BY_ANGLE = "g", "phase.weight"
"""Quantities that belong to the phase function."""


def build_volume(scene_file: SceneFile, dtype: torch.dtype, device: torch.device) -> Volume:
    """The volume of the scene in `dtype` on `device`.

    Raises SceneError with all its problems, or FormatError.
    """
    media, problems = list[_Medium](), Problems()
    for name, section in scene_file.tree.media.items():
        with problems.collecting():
            media.append(_read_medium(scene_file, name, section))
    problems.raise_any()
    grid = _agree_on_grid(scene_file, {key: field for each in media for key, field in each.by_key})
    phases = [_build_phase(scene_file, each, dtype, device) for each in media]
    first, *others = phases
    blend = Blend(first, others[0], torch.tensor(0.5, dtype=dtype)) if others else first
    tree = scene_file.tree
    optimized = tree.optimize.parameters if tree.optimize else {}
    colors = max(each.colors for each in media)
    sizes = [view.camera.resolution for view in tree.views if view.camera.resolution is not None]
    needs = needs_of(
        grid,
        blend,
        colors,
        torch.empty(0, dtype=dtype, device=device),
        choose_rounds(tree, blend),
        # Views that are as large as their images count as nothing: those are not read yet.
        pixels=sum(width * height for width, height in sizes),
        lights=len(tree.lights),
        optimized=optimized,
        varied=sum(_varied(name, one, media, colors) for name, one in optimized.items()),
    )
    if too_much := make_room(needs, device):
        raise scene_file.refused("volume.resolution", too_much)
    volumes = {
        each.name: each.build(grid, phase, dtype, device)
        for each, phase in zip(media, phases, strict=True)
    }
    return volumes[""] if "" in volumes else mix_media(volumes)


@dataclass(frozen=True)
class _Medium:
    """What the scene says at `key` of the medium `name`, "" where it is the only one.

    `fields` are those of its files by variable, and where the scene names them.
    """

    name: str
    key: str
    section: VolumeSection | MediumSection
    fields: Mapping[str, tuple[str, Field]]

    @property
    def by_key(self) -> list[tuple[str, Field]]:
        """Its fields, by where the scene names their files."""
        return list(self.fields.values())

    @property
    def colors(self) -> int:
        """3 where one of its quantities differs by color, else 1."""
        given = [value for _, value in _quantities(self.section).values()]
        of_files = [field.values.ndim == 4 for _, field in self.by_key]
        return 3 if any(of_files) or any(isinstance(value, tuple) for value in given) else 1

    def values(self, name: str) -> Tensor:
        """The quantity `name`, float64 [C] or [C, z, y, x]."""
        if name in self.fields:
            values = torch.from_numpy(self.fields[name][1].values).double()
            return values[None] if values.ndim == 3 else values.permute(3, 0, 1, 2).contiguous()
        value: Color = getattr(self.section, name)
        return torch.tensor([value] if isinstance(value, float) else value, dtype=torch.float64)

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
        density = self.values("density")
        density = (
            density[0] if density.ndim == 4 else torch.full(grid.shape, density.item(), dtype=dtype)
        )
        return Volume(grid, density.to(device, dtype), sigma_a, sigma_s, phase)


def _varied(name: str, settings: ParameterSettings, media: list[_Medium], colors: int) -> int:
    """How many numbers a cell the parameter `name` has."""
    medium, last = split_name(name)
    kind = kind_of(name)
    if last == "density":
        return 1
    is_field = settings.field
    if is_field is None:
        of_file = any(each.name == medium[6:-1] and last in each.fields for each in media)
        is_field = of_file or isinstance(settings.init, FieldFile)
    return (colors if kind.is_color else 1) if kind.is_cellwise and is_field else 0


def _read_medium(
    scene_file: SceneFile, name: str, section: VolumeSection | MediumSection
) -> _Medium:
    place = f"volume.media.{name}" if name else "volume"
    problems, fields = Problems(), {}
    for variable, (key, value) in _quantities(section).items():
        if isinstance(value, FieldFile):
            called = value.name or variable.removeprefix(PHASE)
            read = partial(_read_quantity, name=variable, called=called)
            with problems.collecting():
                at = f"{place}.{key}.file"
                fields[variable] = at, read_referenced(scene_file, at, value.file, read)
    problems.raise_any()
    return _Medium(name, place, section, fields)


def _quantities(section: VolumeSection | MediumSection) -> dict[str, tuple[str, Any]]:
    """The key and the value of each quantity that a file may give cell by cell, by variable."""
    found = {name: (name, getattr(section, name)) for name in FIELDS if hasattr(section, name)}
    if isinstance(section.phase, HenyeyGreensteinSection):
        found["g"] = "phase.g", section.phase.g
    elif isinstance(section.phase, TwoLobeSection):
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


def _agree_on_grid(scene_file: SceneFile, fields: Mapping[str, Field]) -> Grid:
    """The grid of the scene and of all `fields` of its files, which are by key.

    Raises SceneError with all that do not agree, or where nothing says what the grid is.
    """
    section, problems = scene_file.tree.volume, Problems()
    sizes: dict[str, tuple[int, int, int]] = {key: f.resolution for key, f in fields.items()}
    boxes = {key: _corners(f.bounds) for key, f in fields.items() if f.bounds is not None}
    if section.resolution is not None:
        sizes = {"volume.resolution": section.resolution} | sizes
    if section.bounds is not None:
        boxes = {"volume.bounds": (section.bounds.min, section.bounds.max)} | boxes
    for key, size in sizes.items():
        first = next(iter(sizes))
        if size != sizes[first]:
            problems.note(
                scene_file.refused(
                    key, f"has {_by(size)} cells in x, y, z, but {first} has {_by(sizes[first])}"
                )
            )
    for key, box in boxes.items():
        first = next(iter(boxes))
        if not _same_box(box, boxes[first]):
            problems.note(
                scene_file.refused(
                    key, f"its bounds are {_box(box)}, but {first} says {_box(boxes[first])}"
                )
            )
    for name, known in (("resolution", sizes), ("bounds", boxes)):
        if not known:
            problems.note(
                scene_file.refused(
                    "volume", f"missing key {name!r}, which no field file gives either"
                )
            )
    problems.raise_any()
    return Grid.from_xyz(next(iter(sizes.values())), *next(iter(boxes.values())))


def _corners(bounds: np.ndarray) -> tuple[Triple, Triple]:
    (lx, ly, lz), (ux, uy, uz) = bounds.tolist()
    return (lx, ly, lz), (ux, uy, uz)


def _same_box(one: tuple[Triple, Triple], other: tuple[Triple, Triple]) -> bool:
    """Whether the corners agree to a hundred-thousandth of the box's sides.

    Files may hold them in single precision.
    """
    tolerance = 1e-5 * (np.array(other[1]) - np.array(other[0]))
    return bool((np.abs(np.array(one) - np.array(other)) <= tolerance).all())


def _by(size: tuple[int, int, int]) -> str:
    return " x ".join(map(str, size))


def _box(box: tuple[Triple, Triple]) -> str:
    return " to ".join(f"({', '.join(f'{side:g}' for side in corner)})" for corner in box)


def _build_phase(
    scene_file: SceneFile, medium: _Medium, dtype: torch.dtype, device: torch.device
) -> PhaseFunction:
    """The phase function of `medium` in `dtype` on `device`.

    Raises SceneError, FormatError, or MissingExtraError for droplets without miepython.
    """

    def tensor(value: Any) -> Tensor:
        if isinstance(value, FieldFile):
            name = next(name for name in BY_ANGLE if name in medium.fields)
            return medium.values(name).to(device, dtype)
        return torch.as_tensor(value, dtype=dtype, device=device)

    match section := medium.section.phase:
        case None:
            return HenyeyGreenstein(tensor(medium.section.g))
        case HenyeyGreensteinSection():
            return HenyeyGreenstein(tensor(section.g))
        case TwoLobeSection():
            return TwoLobe(tensor(section.g), tensor(section.weight))
        case TableSection():
            return Tabulated(tensor(_table(scene_file, section, f"{medium.key}.phase")))
        case MieSection():
            return Tabulated(tensor(_droplets(section)))
    return Rayleigh(tensor(0.0))


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
