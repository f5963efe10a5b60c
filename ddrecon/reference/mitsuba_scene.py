"""A scene in Mitsuba's words: nested dictionaries as its `load_dict` takes them.

They are of plain values, so that Mitsuba is not needed here. The one convention: arrays are told
apart by their axes. [4, 4] is a transform, [h, w, 3] a picture, [z, y, x, C] a volume, all float32
but the transform; a tuple is a color and a list a vector.

Where albedo differs from cell to cell, Mitsuba interpolates it where we interpolate the scattering
coefficient, so it is handed over on `FINER` times finer cells (in grids of at most `MANY`), between
whose centers little is left of that difference.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ddrecon.cameras import cast_rays
from ddrecon.errors import SceneError
from ddrecon.grid import Grid
from ddrecon.light.ground import Ground
from ddrecon.light.lights import AmbientLight, DirectionalLight, EnvironmentLight, Light, PointLight
from ddrecon.light.sky import rotate_directions
from ddrecon.medium.coefficients import Volume, for_cells
from ddrecon.medium.phase import HenyeyGreenstein, Mixture, PhaseFunction, Rayleigh
from ddrecon.scene import Scene, View

LONGEST = 1024
"""Segments of the longest path. There is no Russian roulette: Mitsuba ends a twentieth of all paths
at each scattering, whatever they carry, and what is left over of the long paths in dense media
weighs so much that noise was ten times higher.
"""
SAMPLES = 256
"""Paths a pixel where nobody says otherwise."""
GRAY = 1e-5
"""Colors whose extinctions differ by less, relatively, share their paths."""
FINER, MANY = 3, 2**20
NEAR = 1e-4
"""How far from the eye Mitsuba's rays start, and from the box a ground lies at least, in diagonals
of the box; it wants more than 0.
"""
COSINES = 1 << 15
"""Steps of Mitsuba's tables, which are linear between even cosines: the first is 0.6 degrees."""
SQUARE = 1e-5
"""Pixels this little off square are taken for square: the error is that part of the height."""
FAR = 100.0
"""Half the width of a ground, in diagonals of the box: it ends half a degree below the horizon."""
MEDIUM = "medium"
MITSUBA_AXES = np.array([-1, 1, -1, 1])
"""Signs of a camera's axes: Mitsuba's look along +z with +x to the left."""


class Lamp(NamedTuple):
    """What Mitsuba calls a light, and its class; `place` and `color` are named as ours are."""

    plugin: str
    class_name: str
    place: str
    color: str


LAMPS: dict[type, Lamp] = {
    DirectionalLight: Lamp("directional", "DirectionalEmitter", "direction", "irradiance"),
    PointLight: Lamp("point", "PointLight", "position", "intensity"),
}
"""Lights that differ from Mitsuba's in nothing, scene files included."""


def mitsuba_scene(scene: Scene, views: Sequence[View], depth: int = -1) -> dict[str, Any]:
    """`scene` seen by the cameras of `views`, by paths of at most `depth` segments.

    With 2 light scatters once; -1 is `LONGEST`. The cameras are `sensor_0`, `sensor_1`, ... Raises
    SceneError for what Mitsuba cannot show: several environment maps, a phase function that differs
    by color or a g that does so by cell, pixels that are not square, and views of whose rays only
    some start inside the volume.
    """
    grid = scene.volume.grid
    if grid.periodic:
        raise SceneError("volume.periodic: Mitsuba's volumes do not repeat")
    return {
        "type": "scene",
        "integrator": {
            "type": "volpath" if is_gray(scene.volume) else "volpathmis",
            "max_depth": depth if depth > 0 else LONGEST,
            "rr_depth": 2 * LONGEST,
            "hide_emitters": not scene.render.background,
        },
        MEDIUM: _medium(scene.volume),
        **{sensor_id(index): _sensor(view, grid) for index, view in enumerate(views)},
        # The box's faces do nothing but contain the medium; Mitsuba's cube runs from -1 to 1.
        "box": {
            "type": "cube",
            "to_world": _place(np.array(grid.center_xyz), np.array(grid.extent[::-1]) / 2),
            "bsdf": {"type": "null"},
            "interior": {"type": "ref", "id": MEDIUM},
        },
        **mitsuba_lights(scene.lights),
        **(_ground(scene.ground, grid) if scene.ground else {}),
    }


def sensor_id(index: int) -> str:
    """What the camera of view number `index` is called."""
    return f"sensor_{index}"


def is_gray(volume: Volume) -> bool:
    """Whether red, green and blue are extinguished alike, everywhere."""
    sigma_t = for_cells(volume.sigma_a) + for_cells(volume.sigma_s)
    return bool((sigma_t - sigma_t.mean(0)).abs().max() <= GRAY * sigma_t.max())


def _medium(volume: Volume) -> dict[str, Any]:
    if volume.emission is not None or volume.black_body is not None:
        raise SceneError("volume: it glows, and Mitsuba's media emit nothing")
    if volume.index != 1:
        raise SceneError("volume.index: Mitsuba is not told how faces refract light")
    # In double precision on the CPU; cross sections are [C, z, y, x] or [C, 1, 1, 1].
    density, sigma_a, sigma_s = (
        value.detach().cpu().double() for value in (volume.density, volume.sigma_a, volume.sigma_s)
    )
    if volume.support is not None:
        density = density * volume.support.cpu()
    volume = Volume(volume.grid, density, for_cells(sigma_a), for_cells(sigma_s), volume.phase)
    sigma_t = volume.sigma_a + volume.sigma_s
    if is_gray(volume):
        sigma_t = sigma_t.mean(0, keepdim=True)
    if sigma_t.numel() == 1:
        field, scale = volume.density[None], sigma_t.item()
    else:
        field, scale = sigma_t * volume.density, 1.0
    return {
        "type": "heterogeneous",
        "sigma_t": _grid_volume(field, volume.grid),
        "scale": scale,
        "albedo": _albedo(volume),
        "phase": _phase(volume.phase, volume.grid),
    }


def _albedo(volume: Volume) -> Any:
    """What part of extinction scatters, 0 of none: a number, a color or a volume."""
    absorbing, scattering = torch.broadcast_tensors(volume.sigma_a, volume.sigma_s)
    if absorbing[0].numel() > 1:
        # Finer cells: Mitsuba interpolates the albedo, we the scattering coefficient.
        times = FINER if volume.grid.cells <= MANY else 1
        fields = (sigma * volume.density for sigma in (absorbing, scattering))
        absorbing, scattering = (
            interpolate(field[None], scale_factor=times, mode="trilinear")[0] for field in fields
        )
    extinction = absorbing + scattering
    albedo = (scattering / torch.where(extinction > 0, extinction, 1)).clamp(max=1)
    if albedo[0].numel() > 1:
        return _grid_volume(albedo, volume.grid)
    return albedo.item() if albedo.numel() == 1 else tuple(albedo.flatten().tolist())


def _phase(phase: PhaseFunction, grid: Grid) -> dict[str, Any]:
    """`phase` as `hg`, `blendphase`, `rayleigh`, or by its values as `tabphase`.

    A weight that differs from cell to cell is a volume on `grid`. Raises SceneError for what
    Mitsuba has not: phase functions that differ by color, and a g that does so from cell to cell.
    """
    if phase.colors > 1:
        raise SceneError("volume.phase: differs by color, and Mitsuba's phase functions have none")
    if isinstance(phase, HenyeyGreenstein):
        if phase.cells is not None:
            raise SceneError(
                "volume.g: differs from cell to cell, and Mitsuba's hg has one g;"
                " it knows two_lobe with a weight per cell"
            )
        return {"type": "hg", "g": phase.g.item()}
    if isinstance(phase, Rayleigh):
        return {"type": "rayleigh"}
    if isinstance(phase, Mixture):
        first, second = (_phase(lobe, grid) for lobe in phase.parts)
        complement = 1 - (phase.weight if phase.cells is None else phase.cells).detach().cpu()
        weight = complement.item() if phase.cells is None else _grid_volume(complement, grid)
        return {"type": "blendphase", "weight": weight, "first": first, "second": second}
    cosines = torch.linspace(-1, 1, COSINES + 1, dtype=torch.float64)
    values = phase.map(lambda number: number.detach().cpu().double()).value(cosines)
    return {"type": "tabphase", "values": ", ".join(f"{value:.7g}" for value in values[0].tolist())}


def _grid_volume(values: Tensor, grid: Grid) -> dict[str, Any]:
    """`values` [C, z, y, x] on the box of `grid`."""
    array = np.ascontiguousarray(values.permute(1, 2, 3, 0).float().numpy())
    lower, upper = (np.array(corner) for corner in grid.bounds_xyz)
    return {
        "type": "gridvolume",
        "grid": array,
        "raw": True,
        "to_world": _place(lower, upper - lower),
    }


def _place(origin: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """The transform [4, 4] that scales by `scale` [3] and then shifts by `origin` [3]."""
    matrix = np.diag([*scale, 1.0])
    matrix[:3, 3] = origin
    return matrix


def _ground(ground: Ground, grid: Grid) -> dict[str, dict[str, Any]]:
    """A square in place of the unbounded plane, and one under the box for a map of albedo.

    Mitsuba's runs from -1 to 1 across +z. They lie a little below the box, and the map above the
    other square: of two surfaces in the same place rays meet either.
    """
    up, gap = 2 - ground.plane.axis, NEAR * math.hypot(*grid.extent)
    height = min(ground.plane.height, grid.lower[ground.plane.axis] - gap)

    def square(halves: Sequence[float], height: float, reflectance: Any) -> dict[str, Any]:
        place, middle = np.zeros((4, 4)), np.array([*grid.center_xyz, 1.0])
        middle[up] = height
        for column, axis in enumerate(((up + 1) % 3, (up + 2) % 3, up)):
            place[axis, column] = halves[axis]
        place[:, 3] = middle
        bsdf = {"type": "diffuse", "reflectance": reflectance}
        return {"type": "rectangle", "to_world": place, "bsdf": bsdf}

    is_map = ground.albedo.ndim > 1
    wide = 3 * [FAR * gap / NEAR], height - is_map * gap, _color(ground.mean_albedo)
    squares = {"ground": square(*wide)}
    if is_map:
        # A picture's rows run along the square's second axis.
        pixels = ground.albedo.detach().cpu().permute((2, 1, 0) if up == 1 else (1, 2, 0))
        picture = np.ascontiguousarray(pixels.expand(-1, -1, 3), np.float32)
        texture = {"type": "bitmap", "bitmap": picture, "raw": True, "wrap_mode": "clamp"}
        halves = [side / 2 for side in grid.extent[::-1]]
        squares["ground_map"] = square(halves, height, texture)
    return squares


def _sensor(view: View, grid: Grid) -> dict[str, Any]:
    """The camera of `view`, whose film keeps the mean of each pixel."""
    camera, matrix, diagonal = view.camera, np.eye(4), math.hypot(*grid.extent)
    matrix[:3] = camera.pose.detach().cpu().double().numpy()
    height, width = camera.size
    film = {"type": "hdrfilm", "width": width, "height": height, "component_format": "float32"}
    sensor: dict[str, Any] = {
        "film": film | {"rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": SAMPLES},
        "near_clip": NEAR * diagonal,
        "far_clip": 2 * (FAR * diagonal + math.dist(matrix[:3, 3], grid.center_xyz)),
        "to_world": matrix * MITSUBA_AXES,
    }
    start = cast_rays(camera).origin.detach()
    lower, upper = (start.new_tensor(corner) for corner in (grid.lower, grid.upper))
    is_inside = ((start > lower) & (start < upper)).all(1)
    if bool(is_inside.any()):  # Mitsuba is told so once for all rays
        if not bool(is_inside.all()):
            raise SceneError(
                f"view {view.name!r}: Mitsuba cannot show rays of which only some start inside the "
                "volume; move the camera back"
            )
        sensor[MEDIUM] = {"type": "ref", "id": MEDIUM}
    if camera.is_perspective:
        if not math.isclose(camera.pixel_aspect, 1, rel_tol=SQUARE):
            raise SceneError(
                f"view {view.name!r}: pixels of Mitsuba's perspective cameras are square, "
                f"those of this one {camera.pixel_aspect:.6g} times as high as wide"
            )
        if camera.lens is not None:
            raise SceneError(
                f"view {view.name!r}: Mitsuba's cameras have no lens distortion; leave the view"
                " out, or undistort its picture and give it a camera without"
            )
        x, y = map(float, camera.principal_point)
        return {
            "type": "perspective",
            "fov": 2 * math.degrees(math.atan(camera.half_width)),
            "fov_axis": "x",
            "principal_point_offset_x": 0.5 - x,
            "principal_point_offset_y": 0.5 - y,
            **sensor,
        }
    half_width = float(camera.half_width)
    sensor["to_world"] = sensor["to_world"] * [half_width, half_width * camera.pixel_aspect, 1, 1]
    return {"type": "orthographic", **sensor}


def mitsuba_lights(lights: Sequence[Light]) -> dict[str, dict[str, Any]]:
    """`lights` as Mitsuba's emitters, by names of their own.

    Mitsuba takes one light from infinitely far all around, so ambient light is added to the pixels
    of an environment map.
    Raises SceneError for more than one environment map, and for beams.
    """
    emitters: dict[str, dict[str, Any]] = {}
    ambient, maps = np.zeros(3), list[EnvironmentLight]()
    for index, light in enumerate(lights):
        if lamp := LAMPS.get(type(light)):
            place, color = getattr(light, lamp.place).tolist(), _color(getattr(light, lamp.color))
            emitters[f"light_{index}"] = {"type": lamp.plugin, lamp.place: place, lamp.color: color}
        elif isinstance(light, AmbientLight):
            ambient = ambient + _color(light.radiance)
        elif isinstance(light, EnvironmentLight):
            maps.append(light)
        else:
            raise SceneError(f"lights.{index}: Mitsuba has no Gaussian beams; leave it out")
    if len(maps) > 1:
        raise SceneError(
            f"the scene has {len(maps)} environment maps, and Mitsuba takes one; "
            "give it the one they sum to"
        )
    if maps:
        emitters["around"] = _environment(maps[0], ambient)
    elif ambient.any():
        emitters["around"] = {"type": "constant", "radiance": tuple(ambient.tolist())}
    return emitters


def _environment(light: EnvironmentLight, ambient: np.ndarray) -> dict[str, Any]:
    """The map turned as `ddrecon.light.sky` says, which holds `ambient` [3] as well."""
    radiance = (light.scale * light.radiance).detach().cpu().double().numpy()
    pixels = np.broadcast_to(radiance.transpose(1, 2, 0), (*radiance.shape[1:], 3)) + ambient
    turn = np.eye(4)
    turned = replace(light, rotation=light.rotation.detach().cpu().double())
    turn[:3, :3] = rotate_directions(torch.eye(3, dtype=torch.float64), turned).T
    return {"type": "envmap", "bitmap": np.ascontiguousarray(pixels, np.float32), "to_world": turn}


def _color(value: Tensor) -> tuple[float, ...]:
    return tuple(value.detach().cpu().expand(3).tolist())
