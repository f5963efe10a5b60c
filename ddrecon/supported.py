"""What is not computed together: one rule for scenes of files and of Python."""

from __future__ import annotations

from collections.abc import Iterator

from ddrecon.errors import UsageError
from ddrecon.light.lights import BeamLight, PointLight
from ddrecon.scene import Scene


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
