"""Scene files as tensors: the front door `load_scene`; and what a scene gets that it leaves out."""

import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ddrecon.defaults import choose_diffusion, count_colors
from ddrecon.errors import DataWarning, FormatError, Problems, UsageError, gather
from ddrecon.io.images.table import read_image
from ddrecon.layer import DTYPES
from ddrecon.light.ground import Ground, Plane
from ddrecon.light.lights import (
    BRIGHTNESS,
    AmbientLight,
    BeamLight,
    DirectionalLight,
    EnvironmentLight,
    Light,
    PointLight,
)
from ddrecon.march.windows import look_inside
from ddrecon.medium.coefficients import Volume, mix_media
from ddrecon.medium.phase import Blend
from ddrecon.memory import Needs, numbers_in_cell, refuse_excess
from ddrecon.scene import Scene, View, require_above, require_supported
from ddrecon.scene_file import schema
from ddrecon.scene_file.build_views import Maker, at_frame, build_views
from ddrecon.scene_file.build_volume import build_media, cells_of, read_quantity
from ddrecon.scene_file.load import SceneFile, read_referenced, read_scene, require
from ddrecon.settings import DiffusionSettings, FieldFile, OptimizeSettings, ParameterSettings
from ddrecon.variables.kinds import PHASE, kind_of, split_name, unit_of
from ddrecon.variables.values import (
    component_names,
    find_volume_readers,
    name_each,
    value_of,
)

LIGHTS: dict[type, Callable[..., Light]] = {
    schema.DirectionalSection: DirectionalLight,
    schema.AmbientSection: AmbientLight,
    schema.PointSection: PointLight,
    schema.BeamSection: BeamLight,
}
"""What each section of a light becomes; keys have the same names in both."""
START_OF_EMISSION = 0.1
"""Emission optimized from nothing shows so many times the pictures' brightness."""


def load_scene(
    path: str | os.PathLike[str],
    *,
    overrides: Iterable[str] = (),
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Scene:
    """The scene in the file at `path`, as tensors of `dtype` on `device`.

    `overrides` (`key.path=value`) are put in first; their paths start at the current folder.

    Raises SceneError with one line per problem of the scene, FormatError for a file it names that
    cannot be used, or UsageError for another `dtype` than `DTYPES` and a `device` that is not here.
    """
    return build_scene(read_scene(path, overrides), dtype=dtype, device=device)


def build_scene(
    scene_file: SceneFile, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> Scene:
    """The scene of a file, of a film the first frame, as tensors; raises what `load_scene` does."""
    if dtype not in DTYPES:
        raise UsageError(f"dtype {dtype}: light is computed in float32 or float64")
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise UsageError(f"device {device}: {error}") from None
    if scene_file.tree.frames is not None:
        scene_file = at_frame(scene_file, scene_file.tree.frames.first)
    tree, maker = scene_file.tree, Maker(scene_file, dtype, device)
    media, views, lights, ground = _build_parts(maker)
    combined, optimize = _combine(media), tree.optimize
    if optimize is not None:
        optimize = replace(optimize, parameters=name_each(optimize.parameters, views))
    parameters = optimize.parameters if optimize else {}
    diffusion, _ = choose_diffusion(tree.diffusion, combined, [*media.values()], parameters)
    needs = needs_of_scene(media, views, diffusion, optimize)
    if too_much := refuse_excess(needs, torch.device(device)):
        is_of_views = 2 * needs.of_pixels > needs.total
        raise scene_file.refused("views" if is_of_views else "volume.resolution", too_much)
    # Only now each cell has a number of its own.
    media = {
        name: replace(medium, density=medium.density.contiguous()) for name, medium in media.items()
    }
    volume = media[""] if "" in media else mix_media(media)
    has_up = ground is not None or tree.volume.up != "y"  # which stands where nothing is said
    scene = Scene(
        volume,
        lights,
        views,
        tree.render,
        tree.diffusion,
        optimize,
        path=scene_file.path,
        ground=ground,
        up="xyz".index(tree.volume.up) if has_up else None,
    )
    try:
        require_supported(scene)
        require_above(scene)
        for view in views if volume.index != 1 else ():
            look_inside(view.camera, combined.grid, volume.index, scene.render)
    except UsageError as error:
        key, _, fault = str(error).partition(": ")
        raise scene_file.refused(key, fault) from None
    starts = gather(lambda name: _start(scene_file, scene, name, parameters[name]), parameters)
    scene.starts = dict(zip(parameters, starts, strict=True))
    return scene


def _build_parts(
    maker: Maker,
) -> tuple[dict[str, Volume], list[View], list[Light], Ground | None]:
    """Media by name, views, lights and ground; whatever is wrong with any is raised together."""
    tree, problems = maker.tree, Problems()
    media, grid = dict[str, Volume](), None
    with problems.collecting():
        media = build_media(maker)
        grid = next(iter(media.values())).grid
    with problems.collecting():
        views = build_views(maker, grid)
    lights: list[Light] = []
    for index, section in enumerate(tree.lights):
        with problems.collecting():
            lights.append(_build_light(maker, f"lights.{index}.", section))
    ground = None
    if media and tree.ground is not None:
        with problems.collecting():
            ground = _build_ground(maker, tree.ground)
    for name, settings in tree.optimize.parameters.items() if tree.optimize else ():
        if isinstance(settings.init, FieldFile):
            with problems.collecting():
                key = f"optimize.parameters.{name}.init.file"
                require(maker.scene_file, key, settings.init.file)
    problems.raise_any()
    return media, views, lights, ground


def _build_light(maker: Maker, owner: str, section: schema.LightSection) -> Light:
    """The light of `section`, whose variables begin with `owner`."""
    if not isinstance(section, schema.EnvironmentSection):
        numbers = {
            key: maker.color(owner + key, value) if key in BRIGHTNESS else maker.tensor(value)
            for key, value in vars(section).items()
        }
        return LIGHTS[type(section)](**numbers)
    pixels = read_referenced(maker.scene_file, f"{owner}file", section.file, _read_map)
    radiance = _map_of(maker, f"{owner}radiance", pixels)
    scale, rotation = maker.tensor(section.scale), maker.tensor(section.rotation)
    return EnvironmentLight(radiance, scale, rotation, section.directions, section.up)


def _map_of(maker: Maker, name: str, pixels: np.ndarray) -> Tensor:
    """The variable `name` [C, h, w] of `pixels` [h, w, 3]; gray unless that may change."""
    if not maker.tree.may_change(name) and bool((pixels == pixels[..., :1]).all()):
        pixels = pixels[..., :1]
    return maker.picture(pixels)


def _build_ground(maker: Maker, section: schema.GroundSection) -> Ground:
    name, albedo = "ground.albedo", section.albedo
    if isinstance(albedo, FieldFile):
        pixels = read_referenced(maker.scene_file, f"{name}.file", albedo.file, _read_albedo)
        reflected = _map_of(maker, name, pixels)
    else:
        reflected = maker.color(name, albedo)
    return Ground(reflected, Plane(section.height, "zyx".index(maker.tree.volume.up)))


def _read_albedo(path: Path) -> np.ndarray:
    pixels = read_image(path).pixels
    if pixels.min() < 0 or pixels.max() > 1:
        ends = f"{pixels.min():.3g} to {pixels.max():.3g}"
        raise FormatError(path, f"has values from {ends}; an albedo is from 0 to 1")
    return pixels


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
    if negative := np.count_nonzero(pixels.min(axis=2) < 0):
        fault = f"{negative} pixels with negative radiance are taken as 0"
        warnings.warn(f"{path}: {fault}", DataWarning, 4)
    return pixels.clip(min=0)


def _combine(media: Mapping[str, Volume]) -> Volume:
    """The first of `media`, with the phase function of all: of two a blend of both."""
    first, *more = media.values()
    if not more:
        return first
    half = first.density.new_tensor(0.5)
    return replace(first, phase=Blend(first.phase, more[0].phase, half))


def needs_of_scene(
    media: Mapping[str, Volume],
    views: Sequence[View],
    diffusion: DiffusionSettings,
    optimize: OptimizeSettings | None,
) -> Needs:
    """What the memory of a scene with these parts depends on.

    Of one medium that is alone its name is "". Derivatives count where something is optimized.
    """
    combined, parameters = _combine(media), optimize.parameters if optimize else {}
    colors = count_colors(combined, media.values())
    is_directed = "g" in parameters or bool((combined.phase.moments(3)[:, 1:] != 0).any())
    varied = sum(_varied(name, chosen, media, colors) for name, chosen in parameters.items())
    numbers = numbers_in_cell(colors, varied, is_directed, diffusion)
    return Needs(
        resolution=combined.grid.shape[::-1],
        # Light is computed in cells so many times as narrow along these axes.
        numbers=numbers
        * diffusion.times ** len(diffusion.refine_along)
        * 2 ** len(diffusion.halved),
        pixels=sum(view.camera.size[0] * view.camera.size[1] for view in views),
        size=combined.density.element_size(),
    )


def _varied(
    name: str, settings: ParameterSettings, media: Mapping[str, Volume], colors: int
) -> int:
    """How many numbers a cell the parameter `name` has."""
    (owner, last), kind = split_name(name), kind_of(name)
    medium = media.get(owner.removeprefix("media.").strip("."))
    if medium is None or not kind.is_cellwise or last not in (read := find_volume_readers(medium)):
        return 0
    value = read[last]()
    is_field = value.ndim >= 3 or isinstance(settings.init, FieldFile)
    is_field = is_field or (last == "emission" and not bool(value.any()))
    is_field = is_field if settings.field is None else settings.field
    return is_field * (colors if kind.is_color else 1)


def _start(scene_file: SceneFile, scene: Scene, name: str, settings: ParameterSettings) -> Tensor:
    key, cells = f"optimize.parameters.{name}", scene.volume.grid.shape
    try:
        value = value_of(scene, name).clone()
    except UsageError as error:
        raise scene_file.refused(key, str(error)) from None
    kind, init, is_field = kind_of(name), settings.init, settings.field
    if name == "emission" and not bool(value.any()):
        # As bright as the pictures, all over the box; cell by cell unless the scene says otherwise.
        value = torch.full_like(value, START_OF_EMISSION * unit_of(scene, name))
        is_field = is_field is not False
    if isinstance(init, FieldFile):
        if not kind.is_cellwise:
            raise scene_file.refused(f"{key}.init.file", f"{name} is not a field: give its numbers")
        called = init.name or split_name(name)[1].removeprefix(PHASE)
        read = partial(read_quantity, name=name, called=called)
        field = cells_of(read_referenced(scene_file, f"{key}.init.file", init.file, read)).to(value)
        if tuple(field.shape[-3:]) != cells:
            fault = (
                f"has {list(field.shape[-3:])} cells [z, y, x], but the volume has {list(cells)}"
            )
            raise scene_file.refused(f"{key}.init.file", fault)
        value = field if kind.is_color else field[0]
    elif init is not None:
        value = _fill(scene_file, f"{key}.init", name, init, value)
    if kind.is_cellwise and is_field is not None and is_field != (value.ndim >= 3):
        if is_field:
            value = value.view(*value.shape, 1, 1, 1).expand(*value.shape, *cells).clone()
        else:
            value, high = value.flatten(-3).aminmax(dim=-1)
            if not torch.equal(value, high):
                advice = "give init: number, or leave field: false out"
                fault = f"differs from cell to cell where it starts; {advice}"
                raise scene_file.refused(key, fault)
    if not kind.allows(value):
        raise scene_file.refused(f"{key}.init", f"must be {kind.limits} everywhere")
    return value


def _fill(
    scene_file: SceneFile, key: str, name: str, init: float | tuple[float, ...], value: Tensor
) -> Tensor:
    """`value` with every entry `init`, or every color or component its own."""
    kind, numbers = kind_of(name), value.new_tensor(init)
    count = len(component_names(name, value)) if kind.components else 0
    if not (numbers.ndim or count):
        return numbers.expand_as(value).clone()
    if kind.is_color and numbers.shape == (3,):
        return numbers.view(-1, *[1] * (value.ndim - 1)).expand(3, *value.shape[1:]).clone()
    if numbers.shape == value.shape and numbers.ndim == 1 and not kind.is_color:
        return numbers
    expected = f"a list of {count} numbers" if count else "one number"
    expected += " or [r, g, b]" if kind.is_color else ""
    length = f", found a list of {len(init)}" if isinstance(init, tuple) else ""
    raise scene_file.refused(key, f"expected {expected}{length}")
