"""What a scene is as tensors: a volume, its lights and its views, and the settings of both.

Also what of it is not computed together, in files and in Python, and cameras around its volume.

The physics and the reconstruction read these records; `ddrecon.scene_file` has how they are written
in a file.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from ddrecon.cameras import Camera, twist
from ddrecon.defaults import choose_diffusion, choose_exchanges, find_occupied
from ddrecon.errors import UsageError, suggestion
from ddrecon.grid import Triple
from ddrecon.light.ground import Ground
from ddrecon.light.lights import BeamLight, Light, PointLight
from ddrecon.march.samplers import choose_steps
from ddrecon.medium.coefficients import Volume
from ddrecon.records import bounded, faults_of
from ddrecon.settings import DiffusionSettings, OptimizeSettings, RenderSettings


@dataclass(eq=False)
class View:
    """One view: its camera, and its target `image` [3, h, w] (linear radiance) where it has one.

    `mask` [h, w] is 1 where a pixel counts and 0 where it is ignored; None counts all. Test views
    are never optimized on; `weight` > 0 is how much a training view counts.

    What its camera does to radiance (E9.1): `exposure` > 0 and `offset`, [1] or [3], None for 1 and
    0; `background` [C, h, w] or [C, 1, 1] is what the picture shows where the volume is empty, None
    for the light behind it. `step` says how the picture errs, see `ddrecon.pictures`.
    """

    name: str
    camera: Camera
    image: Tensor | None = None
    mask: Tensor | None = None
    is_test: bool = False
    weight: float = bounded(1.0, above=0)
    exposure: Tensor | None = None
    offset: Tensor | None = None
    background: Tensor | None = None
    step: float = bounded(0.0, minimum=0)

    @property
    def seen(self) -> Tensor:
        """Its image, black where pixels do not count."""
        assert self.image is not None
        return self.image if self.mask is None else self.image * self.mask


@dataclass(eq=False, repr=False)
class Scene:
    """A scene, of a file or made in Python.

    `optimize` is what its file, `path`, says of reconstruction; `starts` holds the value that each
    optimized parameter starts from; `ground` lies under the volume, where there is any. What
    `render` and `diffusion` leave out is chosen by the medium when the scene is made, and stays
    when the medium changes. So do `occupied` and `exchanges`, where there is a ground: where the
    part of the box begins and ends, along z, y and x from 0 to 1, that has any medium; and how
    often light goes to and fro between that and the ground. `reason`: which settings of
    `diffusion` these are, and why. `up`: which of x, y, z (0, 1, 2) points up; None where cameras
    tell.
    """

    volume: Volume
    lights: list[Light]
    views: list[View]
    render: RenderSettings = field(default_factory=RenderSettings)
    diffusion: DiffusionSettings = field(default_factory=DiffusionSettings)
    optimize: OptimizeSettings | None = None
    starts: dict[str, Tensor] = field(default_factory=dict)
    path: Path | None = None
    ground: Ground | None = None
    reason: str = ""
    up: int | None = None
    occupied: tuple[Triple, Triple] | None = None
    exchanges: int | None = None

    def __post_init__(self) -> None:
        self.settle()

    def settle(self) -> None:
        """Has what settings leave out become what the medium deserves, in files and in Python."""
        if any(faults_of(self, keys=("volume", "render", "diffusion"))):
            return  # it cannot be rendered, which `render` says
        volume, optimized = self.volume, self.optimize.parameters if self.optimize else ()
        media = [*volume.media.values()] if volume.media else [volume]
        with torch.no_grad():
            if self.ground is not None and self.occupied is None:
                self.occupied = find_occupied(volume, media, self.ground, optimized)
                is_periodic = bool(volume.grid.periodic)
                self.exchanges = choose_exchanges(self.ground, is_periodic, optimized)
            self.diffusion, reason = choose_diffusion(self.diffusion, volume, media, optimized)
            if self.render.steps_per_voxel is None:
                steps = choose_steps(volume, self.diffusion.times)
                self.render = replace(self.render, steps_per_voxel=steps)
        self.reason = reason or self.reason

    def view(self, name: str) -> View:
        """The view called `name`; raises UsageError with the nearest name, or all known ones."""
        for view in self.views:
            if view.name == name:
                return view
        raise UsageError(f"no view {name!r}{suggestion(name, [view.name for view in self.views])}")


def require_supported(scene: Scene) -> None:
    """Raises UsageError for what is not computed of `scene`; its line begins with the key."""
    for problem in _unsupported(scene):
        raise UsageError(problem)


def require_above(scene: Scene) -> None:
    """Raises UsageError where a camera of `scene` is not above its ground."""
    if scene.ground is None:
        return
    height, up = scene.ground.plane.height, 2 - scene.ground.plane.axis
    for view in scene.views:
        if float(view.camera.pose[up, 3]) <= height:
            raise UsageError(
                f"ground.height: the camera of view {view.name!r} is not above it along "
                f"{'xyz'[up]}; volume.up says which axis is up"
            )


def _unsupported(scene: Scene) -> Iterator[str]:
    settings, grid, ground = scene.diffusion, scene.volume.grid, scene.ground
    is_printed, is_limited = settings.scheme == "printed", settings.model == "flux_limited"
    if settings.model != "none":  # whose rounds nobody makes
        yield from (f"diffusion.{key}: {problem}" for key, problem in settings.violations())
    if ground is not None:
        if is_printed:
            yield "ground: the printed scheme has none; leave diffusion.scheme out"
        axis, height = ground.plane.axis, ground.plane.height
        if height > grid.lower[axis]:
            yield (
                f"ground.height: {height:g} is above the bottom of the box, {grid.lower[axis]:g} "
                f"along {'zyx'[axis]}; a ground lies there or below"
            )
    if grid.periodic:
        if is_printed or is_limited:
            yield "diffusion: volume.periodic is for model p1 with scheme conservative, or none"
        yield from _unrepeated(scene)
    refracted = {
        "ground": ground is not None,
        "diffusion.halve_along": bool(settings.halved),
        "diffusion.scheme: printed": is_printed,
        "diffusion.model: flux_limited": is_limited,
        "point lights": any(isinstance(light, PointLight) for light in scene.lights),
    }
    for name in [name for name, is_so in refracted.items() if is_so and scene.volume.index != 1]:
        yield f"volume.index: there is none with {name}"


def _unrepeated(scene: Scene) -> Iterator[str]:
    """What there is not in a volume that is periodic."""
    for number, light in enumerate(scene.lights):
        if isinstance(light, PointLight | BeamLight):
            problem = f"a {type(light).__name__} does not repeat as the volume does"
            yield f"lights.{number}: {problem}; leave volume.periodic out"
    if scene.ground is not None:
        axis = scene.ground.plane.axis
        if axis in scene.volume.grid.periodic:
            yield f"ground: lies across {'zyx'[axis]}, along which the volume is periodic"
        if scene.ground.albedo.ndim > 1:
            yield "ground.albedo: a map does not repeat as the volume does: give a number"
    if scene.volume.index != 1:
        yield "volume.index: faces that repeat refract nothing: leave index or periodic out"
    for name, parameter in scene.optimize.parameters.items() if scene.optimize else ():
        if parameter.support is not None:
            key = f"optimize.parameters.{name}.support"
            yield f"{key}: is for volumes that do not repeat: leave it out"


def upright_axis(scene: Scene) -> int:
    """Which of x, y, z (0, 1, 2) points up in `scene`.

    A scene that does not say has the one nearest to the sum of its cameras' up vectors.
    """
    if scene.up is not None:
        return scene.up
    upward = torch.stack([view.camera.pose[:, 1] for view in scene.views])
    return int(upward.sum(0).abs().argmax())


def place_turntable(scene: Scene, view: View, count: int) -> list[View]:
    """`count` >= 1 views, from `view` in equal steps once around the volume of `scene`.

    They are called `ring_000`, which is that of `view`, `ring_001` and so on.
    """
    axis, center = upright_axis(scene), scene.volume.grid.center_xyz
    # What points up, in the camera's own axes, and no shift.
    upward = torch.cat([view.camera.pose[axis, :3], view.camera.pose.new_zeros(3)])
    return [
        View(f"ring_{i:03d}", twist(view.camera, 2 * math.pi * i / count * upward, center))
        for i in range(count)
    ]
