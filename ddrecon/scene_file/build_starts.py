"""The value each optimized parameter starts from.

It is what the scene says of the parameter, unless `init` or `field` ask for something else.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from ddrecon.errors import UsageError
from ddrecon.io.images.table import read_image
from ddrecon.io.volumes.table import read_field
from ddrecon.scene import Scene
from ddrecon.scene_file.load import SceneFile, read_referenced, require
from ddrecon.scene_file.problems import Problems, suggestion
from ddrecon.settings import FieldFile, ParameterSettings
from ddrecon.variables.kinds import PHASE, kind_of, split_name
from ddrecon.variables.values import component_names, value_of, variable_names


def require_start_files(scene_file: SceneFile, problems: Problems) -> None:
    """Notes every file to start from that is not there."""
    optimize = scene_file.tree.optimize
    for name, settings in optimize.parameters.items() if optimize else ():
        if isinstance(settings.init, FieldFile):
            with problems.collecting():
                require(scene_file, f"optimize.parameters.{name}.init.file", settings.init.file)


def build_starts(scene_file: SceneFile, scene: Scene) -> dict[str, Tensor]:
    """The value each optimized parameter of `scene` starts from, by name.

    Raises SceneError with all problems, or FormatError.
    """
    problems, starts = Problems(), {}
    for name, settings in scene.optimize.parameters.items() if scene.optimize else ():
        with problems.collecting():
            starts[name] = _start(scene_file, scene, name, settings)
    problems.raise_any()
    return starts


def _start(scene_file: SceneFile, scene: Scene, name: str, settings: ParameterSettings) -> Tensor:
    key = f"optimize.parameters.{name}"
    try:
        value = value_of(scene, name).clone()
    except UsageError:
        raise scene_file.refused(
            key, f"the scene has no such number{suggestion(name, variable_names(scene))}"
        ) from None
    kind = kind_of(name)
    if isinstance(settings.init, FieldFile):
        read = _read_cells if kind.is_cellwise else _read_pixels
        value = read(scene_file, f"{key}.init.file", name, settings.init, value)
    elif settings.init is not None:
        value = _fill(scene_file, f"{key}.init", name, settings.init, value)
    if kind.is_cellwise:
        value = _spread(scene_file, key, settings, value, scene.volume.grid.shape)
    if not bool(((value >= kind.low) & (value <= kind.high)).all()):
        raise scene_file.refused(
            f"{key}.init", f"must be at least {kind.low:g} and at most {kind.high:g} everywhere"
        )
    return value


def _read_cells(
    scene_file: SceneFile, key: str, name: str, init: FieldFile, value: Tensor
) -> Tensor:
    """The file's values per cell, [C, z, y, x] or, where there are no colors, [z, y, x]."""
    read = partial(read_field, name=init.name or split_name(name)[1].removeprefix(PHASE))
    field = torch.from_numpy(read_referenced(scene_file, key, init.file, read).values).to(value)
    has_colors = field.ndim == 4
    if kind_of(name).is_color:
        return field.permute(3, 0, 1, 2) if has_colors else field[None]
    if has_colors:
        raise scene_file.refused(
            key,
            f"{name} has no colors, but the file has {list(field.shape)} values [z, y, x, color]",
        )
    return field


def _read_pixels(
    scene_file: SceneFile, key: str, name: str, init: FieldFile, value: Tensor
) -> Tensor:
    """The file's radiance per pixel of an environment map, [3, h, w]."""
    if value.ndim != 3:
        raise scene_file.refused(key, f"{name} is not a field or map: give its numbers")
    image = read_referenced(scene_file, key, init.file, read_image)
    pixels = torch.from_numpy(image.pixels).permute(2, 0, 1).to(value)
    if pixels.shape[1:] != value.shape[1:]:
        raise scene_file.refused(
            key, f"is {_size(pixels)} pixels, but the scene's map is {_size(value)}"
        )
    return pixels


def _size(pixels: Tensor) -> str:
    return f"{pixels.shape[2]} x {pixels.shape[1]}"


def _fill(
    scene_file: SceneFile, key: str, name: str, init: float | tuple[float, ...], value: Tensor
) -> Tensor:
    """`value` with every entry `init`, or every color or component its own."""
    kind = kind_of(name)
    count = len(component_names(name, value)) if kind.components else 0
    if isinstance(init, float) and not count:
        return torch.full_like(value, init)
    if isinstance(init, tuple) and kind.is_color and len(init) == 3:
        colors = value.new_tensor(init).view(-1, *[1] * (value.ndim - 1))
        return colors.expand(3, *value.shape[1:]).clone()
    if isinstance(init, tuple) and count and len(init) == count:
        return value.new_tensor(init)
    if isinstance(init, tuple) and value.ndim == 1 and not count and len(init) == len(value):
        return value.new_tensor(init)
    expected = f"a list of {count} numbers" if count else "one number"
    if kind.is_color:
        expected += " or [r, g, b]"
    given = f", found a list of {len(init)}" if isinstance(init, tuple) else ""
    raise scene_file.refused(key, f"expected {expected}{given}")


def _spread(
    scene_file: SceneFile,
    key: str,
    settings: ParameterSettings,
    value: Tensor,
    shape: tuple[int, int, int],
) -> Tensor:
    """`value` as a field of `shape`, or as one number (a color), as the scene asks for."""
    is_field = value.ndim >= 3
    if settings.field is None or settings.field == is_field:
        if is_field and tuple(value.shape[-3:]) != shape:
            raise scene_file.refused(
                f"{key}.init.file",
                f"has {list(value.shape[-3:])} cells [z, y, x], but the volume has {list(shape)}",
            )
        return value
    if settings.field:
        return value.view(*value.shape, 1, 1, 1).expand(*value.shape, *shape).clone()
    single = value.flatten(-3).amin(-1)
    if not torch.equal(single, value.flatten(-3).amax(-1)):
        raise scene_file.refused(
            key,
            "differs from cell to cell where it starts;"
            " give init: number, or leave field: false out",
        )
    return single
