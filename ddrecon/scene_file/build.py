"""Scene files as tensors: the front door `load_scene`; and what a scene gets that it leaves out."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.errors import DataWarning, FormatError, Problems, UsageError, suggestion
from ddrecon.grid import Grid
from ddrecon.io.images.table import read_image
from ddrecon.layer import DTYPES
from ddrecon.light.ground import Ground, Plane
from ddrecon.light.lights import (
    AmbientLight,
    BeamLight,
    DirectionalLight,
    EnvironmentLight,
    Light,
    PointLight,
)
from ddrecon.march.samplers import choose_steps, greatest_depth
from ddrecon.march.windows import look_inside
from ddrecon.medium.coefficients import Volume
from ddrecon.medium.mixture import mix_media
from ddrecon.medium.phase import PhaseFunction
from ddrecon.medium.phase_blend import Blend
from ddrecon.memory import Needs, count_threads, make_room
from ddrecon.numerics.harmonics import count_harmonics
from ddrecon.ranks import cells_are_shared
from ddrecon.renderer import require_supported
from ddrecon.scene import Scene, View
from ddrecon.scene_file.build_views import build_views
from ddrecon.scene_file.build_volume import build_media, cells_of, read_quantity
from ddrecon.scene_file.frames import at_frame
from ddrecon.scene_file.load import SceneFile, read_referenced, read_scene, require
from ddrecon.scene_file.schema import (
    AmbientSection,
    BeamSection,
    Color,
    DirectionalSection,
    LightSection,
    PointSection,
    SceneTree,
)
from ddrecon.settings import DiffusionSettings, FieldFile, OptimizeSettings, ParameterSettings
from ddrecon.variables.kinds import PHASE, kind_of, split_name, unit_of
from ddrecon.variables.values import component_names, name_each, value_of, variable_names

MOST_ROUNDS = 16
"""Rounds until light comes to rest; in all cases measured it has by then."""
MORE_ROUNDS = 0.3, 0.6
"""A second moment of the phase function above one of these deserves a round more: by about so much
a round multiplies what is left. For Henyey-Greenstein that is a |g| of 0.55 and 0.77.
"""
FEW_ANGLES = 0.1
"""A second moment up to this needs no angles beyond diffusion's; |g| is up to 0.32 then."""
THICK = 4.0
"""With degree 5 there is a round more, and two where a cell has more optical depths: theta of E7.2
is less than 1 then. Measured on half-spaces and slabs (docs/accuracy.md).
"""
FINER, FINER_FLAT, MOST_CELLS, LONG = 1.5, 0.75, 2**20, 8.0
"""Light is computed in cells a third as wide, or a ninth, where a cell has more optical depths, or
in a flat medium has more than the second, and there are no more cells then. Measured on blocks,
half-spaces and merged balls (docs/accuracy.md). Where there were more, cells stay as wide as they
are along axes along which nothing varies and the box is so many times as long as along another;
gray light may have as many then as three colors have numbers.
"""
SOFT = 3.0
"""Where no face is dense and a cell has more optical depths, one round: later ones darken soft
edges. Measured on merged balls (docs/accuracy.md).
"""
FLAT, BACKWARD = 0.5, 0.2
"""A medium as dense on a face of the box as that part of its mean is flat: light leaves it on one
side of a plane, which takes more directions. So do thick cells, and a backward peak of more than
that part of scattering. Measured on half-spaces, I3RC's step cloud and a plume (docs/accuracy.md).
"""
START_OF_EMISSION = 0.1
"""Emission optimized from nothing shows so many times the pictures' brightness."""
OPTIMIZED = 0.31
"""The second moment that stands for a phase function which is optimized: two rounds."""


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
    if dtype not in DTYPES:
        raise UsageError(f"dtype {dtype}: light is computed in float32 or float64")
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise UsageError(f"device {device}: {error}") from None
    return build_scene(read_scene(path, overrides), dtype=dtype, device=device)


def build_scene(
    scene_file: SceneFile, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> Scene:
    """The scene of a file, of a film the first frame, as tensors; raises what `load_scene` does."""
    if scene_file.tree.frames is not None:
        scene_file = at_frame(scene_file, scene_file.tree.frames.first)
    place, tree = torch.device(device), scene_file.tree
    media, views, lights, ground = _build_parts(scene_file, dtype, place)
    grid, optimize = next(iter(media.values())).grid, tree.optimize
    if optimize is not None:
        optimize = replace(optimize, parameters=name_each(optimize.parameters, views))
    depth = sum(map(greatest_depth, media.values()))
    is_flat, colors = _is_flat(media.values()), _count_colors(media)
    chosen_by = grid, depth, is_flat, colors, _axes_that_vary(media.values())
    diffusion, _ = choose_diffusion(tree, _phase_of(media), *chosen_by)
    needs = needs_of_scene(media, views, lights, diffusion, optimize)
    if too_much := make_room(needs, place):
        raise scene_file.refused("volume.resolution", too_much)
    # Only now each cell has a number of its own.
    media = {
        name: replace(medium, density=medium.density.contiguous()) for name, medium in media.items()
    }
    volume = media[""] if "" in media else mix_media(media)
    diffusion, reason = choose_diffusion(tree, volume.phase, *chosen_by)
    render = tree.render
    if render.steps_per_voxel is None:
        render = replace(render, steps_per_voxel=choose_steps(volume, diffusion.times))
    has_up = ground is not None or tree.volume.up != "y"  # which stands where nothing is said
    scene = Scene(
        volume,
        lights,
        views,
        render,
        diffusion,
        optimize,
        path=scene_file.path,
        ground=ground,
        reason=reason,
        up="xyz".index(tree.volume.up) if has_up else None,
    )
    try:
        require_supported(scene)
        for view in views if volume.index != 1 else ():
            look_inside(view.camera, grid, volume.index, render)
    except UsageError as error:
        key, _, what = str(error).partition(": ")
        raise scene_file.refused(key, what) from None
    problems = Problems()
    for name, settings in optimize.parameters.items() if optimize else ():
        with problems.collecting():
            scene.starts[name] = _start(scene_file, scene, name, settings)
    problems.raise_any()
    return scene


def _build_parts(
    scene_file: SceneFile, dtype: torch.dtype, place: torch.device
) -> tuple[dict[str, Volume], list[View], list[Light], Ground | None]:
    """Media by name, views, lights and ground; whatever is wrong with any is raised together."""
    tree, problems = scene_file.tree, Problems()
    media, grid = dict[str, Volume](), None
    with problems.collecting():
        media = build_media(scene_file, dtype, place)
        grid = next(iter(media.values())).grid
    with problems.collecting():
        views = build_views(scene_file, grid, dtype, place)
    lights: list[Light] = []
    for index, section in enumerate(tree.lights):
        with problems.collecting():
            lights.append(_build_light(scene_file, index, section, dtype, place))
    ground = None
    if media and tree.ground is not None:
        with problems.collecting():
            ground = _build_ground(scene_file, grid, views, dtype, place)
    for name, settings in tree.optimize.parameters.items() if tree.optimize else ():
        if isinstance(settings.init, FieldFile):
            with problems.collecting():
                require(scene_file, f"optimize.parameters.{name}.init.file", settings.init.file)
    problems.raise_any()
    return media, views, lights, ground


def _build_light(
    scene_file: SceneFile,
    index: int,
    section: LightSection,
    dtype: torch.dtype,
    device: torch.device,
) -> Light:
    def tensor(value: Color) -> Tensor:
        return torch.tensor(value, dtype=dtype, device=device)

    def color(name: str) -> Tensor:
        """[1] or [3]"""
        value = getattr(section, name)
        return tensor(scene_file.tree.share_color(f"lights.{index}.{name}", value)).view(-1)

    if isinstance(section, DirectionalSection):
        return DirectionalLight(tensor(section.direction), color("irradiance"))
    if isinstance(section, AmbientSection):
        return AmbientLight(color("radiance"))
    if isinstance(section, PointSection):
        return PointLight(tensor(section.position), color("intensity"))
    if isinstance(section, BeamSection):
        position, direction = tensor(section.position), tensor(section.direction)
        return BeamLight(position, direction, color("power"), tensor(section.radius))
    pixels = read_referenced(scene_file, f"lights.{index}.file", section.file, _read_map)
    radiance = _map_of(scene_file, f"lights.{index}.radiance", pixels).to(device, dtype)
    numbers = tensor(section.scale), tensor(section.rotation)
    return EnvironmentLight(radiance, *numbers, section.directions, section.up)


def _map_of(scene_file: SceneFile, name: str, pixels: np.ndarray) -> Tensor:
    """The variable `name` [C, h, w] of `pixels` [h, w, 3]; gray unless that may change."""
    if not scene_file.tree.may_change(name) and bool((pixels == pixels[..., :1]).all()):
        pixels = pixels[..., :1]
    return torch.from_numpy(pixels).permute(2, 0, 1).contiguous()


def _build_ground(
    scene_file: SceneFile,
    grid: Grid,
    views: Sequence[View],
    dtype: torch.dtype,
    device: torch.device,
) -> Ground:
    tree = scene_file.tree
    section, axis = tree.ground, "zyx".index(tree.volume.up)
    assert section is not None
    if section.height > grid.lower[axis]:
        raise scene_file.refused(
            "ground.height",
            f"{section.height:g} is above the bottom of the box, {grid.lower[axis]:g} along "
            f"{tree.volume.up}; a ground lies there or below",
        )
    for view in views:
        if float(view.camera.pose[2 - axis, 3]) <= section.height:
            what = f"the camera of view {view.name!r} is not above it along {tree.volume.up}"
            what += "; volume.up says which axis is up"
            raise scene_file.refused("ground.height", what)
    if isinstance(section.albedo, FieldFile):
        file = section.albedo.file
        pixels = read_referenced(scene_file, "ground.albedo.file", file, _read_albedo)
        reflected = _map_of(scene_file, "ground.albedo", pixels)
    else:
        albedo = tree.share_color("ground.albedo", section.albedo)
        reflected = torch.tensor(albedo, dtype=dtype).view(-1)
    return Ground(reflected.to(device, dtype), Plane(section.height, axis))


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
        what = f"{negative} pixels with negative radiance are taken as 0"
        warnings.warn(f"{path}: {what}", DataWarning, 4)
    return pixels.clip(min=0)


def _phase_of(media: Mapping[str, Volume]) -> PhaseFunction:
    """The phase function of `media`, of two a blend of both."""
    first, *others = media.values()
    half = first.density.new_tensor(0.5)
    return Blend(first.phase, others[0].phase, half) if others else first.phase


def needs_of_scene(
    media: Mapping[str, Volume],
    views: Sequence[View],
    lights: Sequence[Light],
    diffusion: DiffusionSettings,
    optimize: OptimizeSettings | None,
) -> Needs:
    """What the memory of a scene with these parts depends on.

    Of one medium that is alone its name is "". Derivatives count where something is optimized.
    """
    phase, parameters = _phase_of(media), optimize.parameters if optimize else {}
    first = next(iter(media.values()))
    colors = _count_colors(media)
    is_directed = "g" in parameters or bool((phase.moments(3)[:, 1:] != 0).any())
    varied = [_varied(name, one, media, colors) for name, one in parameters.items()]
    z, y, x = first.grid.shape
    return Needs(
        (x, y, z),
        colors,
        first.density.element_size(),
        pixels=sum(view.camera.size[0] * view.camera.size[1] for view in views),
        has_flux=is_directed,
        has_rounds=diffusion.rounds > 0,
        moments=count_harmonics(diffusion.angles) if is_directed else 1,
        is_limited=diffusion.model == "flux_limited",
        varied=sum(varied) if varied else None,
        lights=len(lights),
        threads=count_threads(first.density.device),
        times=diffusion.times,
        along=diffusion.refine_along,
    )


def _count_colors(media: Mapping[str, Volume]) -> int:
    first = next(iter(media.values()))
    glows = [len(one) for one in (first.emission, first.black_body) if one is not None]
    return max(_phase_of(media).colors, *(len(one.sigma_a) for one in media.values()), *glows)


def _varied(
    name: str, settings: ParameterSettings, media: Mapping[str, Volume], colors: int
) -> int:
    """How many numbers a cell the parameter `name` has."""
    (medium, last), kind = split_name(name), kind_of(name)
    volume = media.get(medium.removeprefix("media.").strip("."))
    if last == "density" or not kind.is_cellwise or volume is None:
        return int(last == "density")
    sigmas = {"sigma_a": [volume.sigma_a], "sigma_s": [volume.sigma_s]}
    both = [volume.sigma_a, volume.sigma_s]
    has_cells = any(sigma.ndim > 1 for sigma in sigmas.get(last, both))
    if not kind.is_color or last.startswith(PHASE):
        has_cells = volume.phase.cells is not None
    if last == "emission" and volume.emission is not None:
        has_cells = volume.emission.ndim > 1 or _is_dark(volume.emission)
    is_given = isinstance(settings.init, FieldFile) or has_cells
    is_field = is_given if settings.field is None else settings.field
    return is_field * (colors if kind.is_color else 1)


def choose_diffusion(
    tree: SceneTree,
    phase: PhaseFunction,
    grid: Grid,
    depth: float,
    is_flat: bool,
    colors: int,
    varies: str,
) -> tuple[DiffusionSettings, str]:
    """The diffusion settings of `tree`, where it leaves any out as a medium deserves; and why.

    By its `phase` function: one that is optimized may become any, and starts as one of strong peaks
    does. If its density is not optimized, also by the `depth` of its thickest cell on `grid`, and
    whether it goes up to a face of the box, `is_flat`. Cells of so many `colors` are divided along
    all axes if there are not too many then, else along those of which it `varies` along any.
    """
    settings = tree.diffusion
    if not settings.rounds:
        return settings, ""
    left = float(phase.moments(3)[:, 2].abs().max())
    optimized = tree.optimize.parameters if tree.optimize else {}
    if any(name == "g" or name.startswith(PHASE) for name in optimized):
        left = max(left, OPTIMIZED)
    reasons = [f"a second moment of {left:.2g} of the phase function"]
    if any(name.endswith("density") for name in optimized):
        depth, is_flat = 0.0, False
    thin = FINER_FLAT if is_flat else FINER
    times, along = _choose_cells(settings, grid, depth / thin, colors, varies)
    if depth > thin:
        reasons.append(f"cells of {depth:.2g} optical depths")
    rounds, degree, causes = _choose_rounds(tree, phase, left, depth / times, is_flat)
    reasons += causes
    if settings.transport_tolerance is not None:
        rounds = MOST_ROUNDS
    chosen = {"transport_rounds": rounds, "degree": degree, "refine": times}
    left_out: dict[str, Any] = {
        key: value for key, value in chosen.items() if getattr(settings, key) is None
    }
    if settings.refine is None and times > 1 and along != settings.refine_along:
        reasons.append("too many cells to divide all")
        left_out["refine_along"] = along
    words = ", ".join(f"{key} {value}" for key, value in left_out.items())
    return replace(settings, **left_out), f"{words}: {', '.join(reasons)}" if words else ""


def _choose_cells(
    settings: DiffusionSettings, grid: Grid, excess: float, colors: int, varies: str
) -> tuple[int, str]:
    """How many times as narrow cells are, and along which axes, as of `choose_diffusion`.

    Cells have `excess` times as many optical depths as are thin.
    """
    times, along, most = settings.times, settings.refine_along, MOST_CELLS
    if along != varies and along == "xyz" and grid.refine(3).cells > most:
        along, most = varies, 3 * MOST_CELLS // colors
    may_refine = settings.refine is None and not cells_are_shared()
    while may_refine and times < 9 and excess > times:
        if grid.refine(3 * times, along).cells > most:
            break
        times *= 3
    return times, along


def _choose_rounds(
    tree: SceneTree, phase: PhaseFunction, left: float, depth: float, is_flat: bool
) -> tuple[int, int, list[str]]:
    """Rounds, their degree, and why, as of `choose_diffusion`; `left` is the second moment."""
    reasons = list[str]()
    rounds, degree = 1 + sum(left > bound for bound in MORE_ROUNDS), 3 if left > FEW_ANGLES else 1
    if is_flat or _turns_back(phase):
        reasons.append("a medium up to a face of the box" if is_flat else "a backward peak")
        rounds, degree = rounds + 1 + (depth > THICK), 5
    elif depth > SOFT:
        rounds = 1
    elif tree.glows:
        # Around a small bright core diffusion is far too bright, and a single round too dark.
        reasons.append("emission")
        rounds = max(rounds, 2)
    if tree.volume.periodic:
        # With fewer directions too much light goes exactly along the axes that repeat.
        reasons.append("a volume that repeats")
        rounds, degree = max(rounds, 2), 5
    if getattr(tree.volume, "index", 1) != 1:
        # What faces reflect comes back again and again.
        reasons.append("faces that reflect light")
        rounds = max(rounds, 4)
    return rounds, degree, reasons


def _turns_back(phase: PhaseFunction) -> bool:
    return float(phase.backward_tail(3, 1).max()) > BACKWARD


def _axes_that_vary(media: Iterable[Volume]) -> str:
    """The axes but those along which `media` are even in a box that is long: light hardly varies
    along these.
    """
    fields, axes = list[Tensor](), ""
    for one in media:
        each = one.density, one.sigma_a, one.sigma_s, one.emission, one.black_body, one.phase.cells
        fields += [field for field in each if field is not None and field.ndim > 2]
        extent = one.grid.extent
    for axis in range(3):
        is_long = extent[axis] > LONG * min(extent)
        if not is_long or any(_varies(field, axis) for field in fields):
            axes = "zyx"[axis] + axes
    return axes


def _varies(field: Tensor, axis: int) -> bool:
    if not field.stride(axis - 3):
        return False
    return not bool((field == field.narrow(axis - 3, 0, 1)).all())


def _is_flat(media: Iterable[Volume]) -> bool:
    """Whether `media`, all together, go up to a face of the box."""
    faces, whole = np.zeros(6), 0.0
    for one in media:
        size, density = float(one.sigma_a.mean() + one.sigma_s.mean()), one.density
        ends = (density.select(axis, end) for axis in range(3) for end in (0, -1))
        faces += [size * float(face.mean()) for face in ends]
        whole += size * float(density.mean())
    return bool(faces.max() > FLAT * whole)


def _start(scene_file: SceneFile, scene: Scene, name: str, settings: ParameterSettings) -> Tensor:
    key = f"optimize.parameters.{name}"
    try:
        value = value_of(scene, name).clone()
    except UsageError:
        raise scene_file.refused(
            key, f"the scene has no such number{suggestion(name, variable_names(scene))}"
        ) from None
    kind = kind_of(name)
    if name == "emission" and _is_dark(value):
        # As bright as the pictures, all over the box; cell by cell unless the scene says otherwise.
        value = torch.full_like(value, START_OF_EMISSION * unit_of(scene, name))
        settings = replace(settings, field=settings.field is not False)
    if isinstance(settings.init, FieldFile):
        if not kind.is_cellwise:
            raise scene_file.refused(f"{key}.init.file", f"{name} is not a field: give its numbers")
        called = settings.init.name or split_name(name)[1].removeprefix(PHASE)
        read = partial(read_quantity, name=name, called=called)
        field = read_referenced(scene_file, f"{key}.init.file", settings.init.file, read)
        cells = cells_of(field).to(value)
        value = cells if kind.is_color else cells[0]
    elif settings.init is not None:
        value = _fill(scene_file, f"{key}.init", name, settings.init, value)
    if kind.is_cellwise:
        value = _spread(scene_file, key, settings, value, scene.volume.grid.shape)
    if not bool(((value >= kind.low) & (value <= kind.high)).all()):
        raise scene_file.refused(
            f"{key}.init", f"must be at least {kind.low:g} and at most {kind.high:g} everywhere"
        )
    return value


def _is_dark(emission: Tensor) -> bool:
    return not bool(emission.any())


def _fill(
    scene_file: SceneFile, key: str, name: str, init: float | tuple[float, ...], value: Tensor
) -> Tensor:
    """`value` with every entry `init`, or every color or component its own."""
    kind = kind_of(name)
    count = len(component_names(name, value)) if kind.components else 0
    if isinstance(init, float):
        if not count:
            return torch.full_like(value, init)
    elif kind.is_color and len(init) == 3:
        colors = value.new_tensor(init).view(-1, *[1] * (value.ndim - 1))
        return colors.expand(3, *value.shape[1:]).clone()
    elif len(init) == (count or value.shape[:1].numel()) and value.ndim == 1 and not kind.is_color:
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
    if is_field and tuple(value.shape[-3:]) != shape:
        raise scene_file.refused(
            f"{key}.init.file",
            f"has {list(value.shape[-3:])} cells [z, y, x], but the volume has {list(shape)}",
        )
    if settings.field is None or settings.field == is_field:
        return value
    if settings.field:
        return value.view(*value.shape, 1, 1, 1).expand(*value.shape, *shape).clone()
    low, high = value.flatten(-3).aminmax(dim=-1)
    if not torch.equal(low, high):
        raise scene_file.refused(
            key,
            "differs from cell to cell where it starts;"
            " give init: number, or leave field: false out",
        )
    return low
