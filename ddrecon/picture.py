"""Pictures of a scene: rays of a camera collect what its volume sends along them (E2.1)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ddrecon.cameras import Camera, Rays
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import UsageError
from ddrecon.light.lights import AmbientLight, EnvironmentLight
from ddrecon.light.reduced import ambient_radiance
from ddrecon.light.sky import environment_radiance
from ddrecon.light_field import FaceLight, LightField
from ddrecon.lighting import send, solve_light
from ddrecon.march.ground import see_ground
from ddrecon.march.integral import march
from ddrecon.march.sight import look_through
from ddrecon.march.windows import look_inside, see_through
from ddrecon.scene import Scene, View


@dataclass(frozen=True)
class Components:
    """The terms of E2.1, each [3, h, w], which sum to the image.

    Light scattered forward once more counts as `multiple`, as in path tracing.
    """

    reduced: Tensor
    single: Tensor
    multiple: Tensor


@dataclass(frozen=True)
class Matte:
    """How an image lies over another one, `image + transmittance * other`.

    `transmittance` [3, h, w] is the part of light from behind that comes through the medium, and of
    a ground 0. `depth` [h, w] is how far [u] along the camera's axis that light is lost, in the
    mean; infinite where none is.
    """

    transmittance: Tensor
    depth: Tensor


def render(scene: Scene, view: str | None = None, memory: SolveMemory | None = None) -> Tensor:
    """Pictures `[views, 3, h, w]` (linear) of all views, or of the one named `view`.

    Differentiable, in reverse and in forward mode, with respect to the tensors of `scene.volume`
    and of its lights. `memory` carries the last solutions from one call to the next, as starting
    points. Raises UsageError when views differ in size: render those one by one.
    """
    views = scene.views if view is None else [scene.view(view)]
    if len({item.camera.size for item in views}) != 1:
        raise UsageError(
            "there is no view, or views differ in size: render them one by one, render(scene, name)"
        )
    return torch.stack(render_each(scene, views, memory or SolveMemory()))


def render_each(scene: Scene, views: Sequence[View], memory: SolveMemory) -> list[Tensor]:
    """The pictures `[3, h, w]` of `views`, which may differ in size, in one light field."""
    light_field = solve_light(scene, memory)
    return [view_picture(light_field, scene, view) for view in views]


def view_picture(
    light_field: LightField, scene: Scene, view: View, derivatives: str = "all"
) -> Tensor:
    """The picture `[3, h, w]` that the camera of `view` takes: exposure times radiance, and offset.

    A background of the view is what its picture shows where nothing is before it (E9.1).
    `derivatives` is as in `view_image`.
    """
    exposure, offset, behind = view.exposure, view.offset, view.background
    if behind is not None:
        behind = behind if offset is None else behind - offset.view(-1, 1, 1)
        behind = behind if exposure is None else behind / exposure.view(-1, 1, 1)
    picture = view_image(light_field, scene, view.camera, derivatives, behind)
    picture = picture if exposure is None else exposure.view(-1, 1, 1) * picture
    return picture if offset is None else picture + offset.view(-1, 1, 1)


def view_image(
    light_field: LightField,
    scene: Scene,
    camera: Camera,
    derivatives: str = "all",
    behind: Tensor | None = None,
) -> Tensor:
    """The image `[3, h, w]` of `camera`, averaged over `samples_per_pixel` rays a pixel (E2.1).

    `derivatives` says which radiance passes derivatives on: `all`, `single` (E2.2 of beams, and
    what is seen unscattered) or `diffusion` (E2.3, with the ambient light in it). The image is the
    same. `behind` [C, h, w] is the radiance behind the volume, in place of that of lights.
    """
    if derivatives == "all":
        return _collect(light_field, scene, camera, behind)
    diffusing = replace(_without_glow(light_field), beams=(), ground=None)
    single = _without_diffuse(light_field), scene, camera, behind
    often = diffusing, _without_background(scene), camera, None
    varied, fixed = (single, often) if derivatives == "single" else (often, single)
    with torch.no_grad():
        constant = _collect(*fixed).detach()
    return _collect(*varied) + constant


def view_components(light_field: LightField, scene: Scene, camera: Camera) -> Components:
    """The image of `camera` split into its terms; `light_field` must be that of `scene`.

    With forward scattering the image sees the delta-Eddington scaled medium; reduced and single
    radiance are those of the medium itself, and the difference, light scattered forward once or
    more, belongs to `multiple`.
    """
    unscattered = replace(scene, diffusion=replace(scene.diffusion, model="none"))
    once = solve_light(unscattered, SolveMemory())
    image = view_image(light_field, scene, camera)
    lit = replace(_without_glow(once), ground=None)
    single = view_image(lit, _without_background(scene), camera)
    reduced = view_image(once, scene, camera) - single
    return Components(reduced, single, image - reduced - single)


def view_matte(light_field: LightField, scene: Scene, camera: Camera) -> Matte:
    """The matte of `camera`; `light_field` must be that of `scene`.

    Light scattered forward counts as coming through where the image sees the delta-Eddington scaled
    medium.
    """
    medium, ground = light_field.medium, light_field.ground
    dark = replace(_without_diffuse(_without_glow(light_field)), beams=(), at_faces=None)
    if ground is not None:
        unlit = torch.zeros_like(ground.even), torch.zeros_like(ground.texels)
        dark = replace(dark, ground=replace(ground, lights=(), even=unlit[0], texels=unlit[1]))
    white = camera.pose.new_ones(3, 1, 1)
    transmittance = _collect(dark, scene, camera, white)
    # A medium that emits as much as it extinguishes is seen by weights whose sum is 1 - T.
    _, _, backward, eye = camera.pose.unbind(1)
    centers = medium.grid.centers(eye.flip(0))
    away = sum(-(c - e) * b for c, e, b in zip(centers, eye.flip(0), backward.flip(0), strict=True))
    extinction = medium.extinction.value.mean(0, keepdim=True)
    dark = replace(dark, ground=None)
    weight, moment = (
        _collect(replace(dark, medium=replace(medium, emission=emission)), scene, camera, 0 * white)
        for emission in (extinction, extinction * away)
    )
    # Rays that touch next to nothing have a quotient of roundings.
    depth = (moment / weight).clamp(away.min(), away.max())
    return Matte(transmittance, torch.where(weight > 0, depth, torch.inf)[0])


def _without_background(scene: Scene) -> Scene:
    return replace(scene, render=replace(scene.render, background=False))


def _without_glow(light_field: LightField) -> LightField:
    return replace(light_field, medium=replace(light_field.medium, emission=None))


def _without_diffuse(light_field: LightField) -> LightField:
    """`light_field` without diffuse light; faces then let in what the medium would emit there."""
    nothing, faces = torch.zeros_like(light_field.diffuse[:1]), light_field.at_faces
    if faces is not None and light_field.medium.emission is not None:
        faces = FaceLight(torch.zeros_like(faces.outside), torch.zeros_like(faces.source))
    else:
        faces = None
    leaving = None if light_field.leaving is None else nothing
    light_field = replace(light_field, diffuse=nothing, skies=(), turned=())
    return replace(light_field, at_faces=faces, leaving=leaving)


def _collect(
    light_field: LightField, scene: Scene, camera: Camera, behind: Tensor | None
) -> Tensor:
    """Radiance [3, h, w]: E2.1, averaged over the rays of each pixel.

    Behind the volume is the ground, or `behind` [C, h, w], or the lights where that is None.
    """
    samples, grid = scene.render.samples_per_pixel, light_field.medium.grid
    if behind is not None:
        behind = behind.expand(-1, *camera.size).flatten(1).repeat(1, samples)
    if light_field.leaving is not None:
        radiance = _collect_refracted(light_field, light_field.leaving, scene, camera, behind)
    else:
        sight = look_through(camera, grid, scene.render)
        behind = _look_behind(scene, sight.rays, behind)
        if light_field.ground is not None:
            ground, medium = light_field.ground, light_field.medium
            behind = see_ground(ground, medium, sight.rays, behind, scene.render)
        radiance = march(send(light_field, sight.rays), sight, scene.render, behind)
    if samples > 1:
        radiance = radiance.unflatten(-1, (samples, -1)).mean(-2)
    return radiance.expand(3, -1).unflatten(-1, camera.size)


def _collect_refracted(
    light_field: LightField, leaving: Tensor, scene: Scene, camera: Camera, behind: Tensor | None
) -> Tensor:
    """The radiance [C, R] along the rays of `camera`, through the faces of a box that refract."""
    medium, settings = light_field.medium, scene.render
    rays, windows = look_inside(camera, medium.grid, medium.index, settings)
    beside = _look_behind(scene, rays, behind)
    radiance = rays.direction.new_zeros(1, 1) if beside is None else beside
    for window in windows:
        through = None if behind is None else behind[:, window.numbers]
        through = _look_behind(scene, Rays(window.points, window.outside, None), through)
        sent = send(light_field, window.sight.rays)
        seen = see_through(window, sent, leaving, medium, through, settings)
        colors = max(len(radiance), len(seen))
        radiance = radiance.expand(colors, len(rays.direction))
        radiance = radiance.index_copy(1, window.numbers, seen.expand(colors, -1))
    return radiance.expand(-1, len(rays.direction))


def _look_behind(scene: Scene, rays: Rays, behind: Tensor | None) -> Tensor | None:
    """`behind` [C, R], or in its place the radiance [C, R] of ambient light and environment maps
    along `rays`, unattenuated; None where there is no such light, or none is to be seen.
    """
    environments = [light for light in scene.lights if isinstance(light, EnvironmentLight)]
    is_lit = environments or any(isinstance(light, AmbientLight) for light in scene.lights)
    if behind is not None or not (is_lit and scene.render.background):
        return behind
    total = ambient_radiance(scene.lights, rays.direction).view(-1, 1)
    for light in environments:
        total = total + environment_radiance(light, rays.direction)
    return total
