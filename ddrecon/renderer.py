"""The paper on one page: light not yet scattered, light scattered often, rays that collect both.

`render` composes only the terms that a scene needs: no diffusion solve when the model is `none` or
nothing scatters, no quadrature over directions unless unscattered ambient light is asked for by
itself, no fluxes Q1 and L1 when g = 0, one color when all is gray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ddrecon.cameras import Camera, Rays
from ddrecon.diffusion.closures import Closure, smooth
from ddrecon.diffusion.conservative import DiffusionProblem, solve_conservative
from ddrecon.diffusion.flux_limited import LIMITERS, solve_flux_limited
from ddrecon.diffusion.implicit import SolveMemory, SolverWithMemory
from ddrecon.diffusion.printed import iterate_jacobi, solve_printed
from ddrecon.diffusion.rounds.transport import run_rounds
from ddrecon.diffusion.solvers import SOLVERS
from ddrecon.errors import UsageError
from ddrecon.light.beam import Beam
from ddrecon.light.environment import environment_radiance
from ddrecon.light.lights import AmbientLight, EnvironmentLight, Light
from ddrecon.light.moments import Moments
from ddrecon.light.outgoing import scatter_towards
from ddrecon.light.pairs import TurnedBeam
from ddrecon.light.point_light import PointBeam
from ddrecon.light.reduced import (
    ambient_radiance,
    ambient_sky,
    reduced_light,
    scatter_sky,
    sum_unscattered_sky,
)
from ddrecon.light.sky import Sky, decompose_lights
from ddrecon.march.emission import Emission
from ddrecon.march.integral import march
from ddrecon.march.sight import look_through
from ddrecon.medium.coefficients import Medium, cut_volume, keep_medium, scale_medium
from ddrecon.medium.remaining import has_backward_peak, remaining_moments
from ddrecon.numerics.autodiff import is_varied
from ddrecon.numerics.remember import is_any_nonzero
from ddrecon.scene import Scene, View
from ddrecon.settings import DiffusionSettings


@dataclass(frozen=True)
class LightField:
    """All light inside a medium.

    `beams` are those of directional and point lights (E2.2), `diffuse` the other light, L0 and L1.
    `skies` are those whose light it lacks: they scatter by the exact phase function, into each
    camera's rays anew. `turned` is light that backward peaks have turned (E8.11).
    """

    medium: Medium
    beams: tuple[Beam | PointBeam, ...]
    diffuse: Moments
    skies: tuple[Sky, ...] = ()
    turned: tuple[TurnedBeam, ...] = ()


@dataclass(frozen=True)
class Components:
    """The terms of E2.1, each [3, h, w], which sum to the image.

    Light scattered forward once more counts as `multiple`, as in path tracing.
    """

    reduced: Tensor
    single: Tensor
    multiple: Tensor


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


def solve_light(scene: Scene, memory: SolveMemory) -> LightField:
    """The light inside the volume of `scene`: reduced, and scattered often (E2.4, E2.5).

    Reduced light alone where nothing scatters twice.
    """
    volume = cut_volume(scene.volume)
    medium = scale_medium(volume, scene.diffusion.angles)
    if not multiply_scatters(medium, scene.diffusion):
        return follow_unscattered_light(keep_medium(volume), scene.lights)
    # Q0 and Q1: beams and skies, not yet scattered; skies' mean enters through the faces (E2.6).
    lights = decompose_lights(scene.lights)
    reduced = reduced_light(medium, lights, medium.degree, has_backward_peak(medium))
    sky = sum_unscattered_sky(medium, lights, medium.degree)
    source = reduced.source
    if sky is not None:
        source = source.plus(sky.weighted(remaining_moments(medium)))
    outside = ambient_radiance(lights, medium.g)
    # L0 and L1: E2.4 to E2.6.
    diffuse = solve_diffuse(medium, source, outside, scene.diffusion, memory)
    # Skies scatter by E2.3 as well; beams by E2.2 on each view ray.
    light = diffuse if sky is None else diffuse.plus(sky)
    return LightField(medium, reduced.beams, light, turned=reduced.turned)


def follow_unscattered_light(medium: Medium, lights: Sequence[Light]) -> LightField:
    """The light inside `medium` that has not been scattered.

    Beams, and by quadrature over directions ambient light and skies.
    """
    parts = decompose_lights(lights)
    beams = reduced_light(medium, parts, 0).beams
    skies = tuple(part for part in parts if isinstance(part, Sky))
    if any(isinstance(part, AmbientLight) for part in parts):
        skies = (*skies, ambient_sky(ambient_radiance(parts, medium.g)))
    nothing = Moments(torch.zeros_like(medium.extinction.value))
    if medium.is_anisotropic:
        return LightField(medium, beams, nothing, skies)
    sky = sum_unscattered_sky(medium, skies, 0)
    return LightField(medium, beams, nothing if sky is None else sky)


def multiply_scatters(medium: Medium, settings: DiffusionSettings) -> bool:
    """Whether light may be scattered more than once.

    It may where the model is not `none`, and sigma_s is not 0 or is being differentiated.
    """
    return settings.model != "none" and (
        is_varied(medium.scattering.scale) or is_any_nonzero(medium.scattering.scale)
    )


def solve_diffuse(
    medium: Medium,
    source: Moments,
    outside: Tensor,
    settings: DiffusionSettings,
    memory: SolveMemory,
) -> Moments:
    """L0 and L1 (E2.4 to E2.6), by the scheme of `settings`.

    `source`: Q0 and Q1; `outside` [C, 1, 1, 1]: the radiance of ambient light.
    """
    if settings.scheme == "printed":
        by_jacobi = SolverWithMemory(iterate_jacobi, settings.tolerance, memory)
        diffusion = smooth(medium.transport_extinction, medium.grid, settings.floor)
        scattering = medium.remaining_scattering
        scattered = source.scaled(scattering, scattering)
        if medium.emission is not None:
            scattered = replace(scattered, mean=scattered.mean + medium.emission)
        return solve_printed(medium, diffusion, scattered, outside, by_jacobi, medium.has_flux)
    solve = SolverWithMemory(SOLVERS[settings.solver], settings.tolerance, memory)
    if settings.model == "flux_limited":
        return solve_flux_limited(
            medium, LIMITERS[settings.limiter], source, outside, solve, medium.has_flux
        )
    closure = Closure(settings.closure, medium.grid, settings.floor)
    problem = DiffusionProblem(medium, closure, source, outside, medium.degree > 0)
    light = solve_conservative(problem, solve)
    return run_rounds(problem, light, solve, settings.rounds, settings.angles)


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
        return _image(light_field, scene, camera, behind)
    nothing = Moments(torch.zeros_like(light_field.diffuse.mean[:1]))
    parts = [
        (replace(light_field, diffuse=nothing, turned=()), scene, camera, behind),
        (
            replace(_without_glow(light_field), beams=(), skies=()),
            _without_background(scene),
            camera,
            None,
        ),
    ]
    varied, fixed = parts if derivatives == "single" else reversed(parts)
    with torch.no_grad():
        rest = _image(*fixed).detach()
    return _image(*varied) + rest


def _without_background(scene: Scene) -> Scene:
    return replace(scene, render=replace(scene.render, background=False))


def _without_glow(light_field: LightField) -> LightField:
    return replace(light_field, medium=replace(light_field.medium, emission=None))


def view_components(light_field: LightField, scene: Scene, camera: Camera) -> Components:
    """The image of `camera` split into its terms; `light_field` must be that of `scene`.

    With forward scattering the image sees the delta-Eddington scaled medium; reduced and single
    radiance are those of the medium itself, and the difference, light scattered forward once or
    more, belongs to `multiple`.
    """
    once = follow_unscattered_light(keep_medium(cut_volume(scene.volume)), scene.lights)
    image = view_image(light_field, scene, camera)
    single = view_image(_without_glow(once), _without_background(scene), camera)
    reduced = view_image(once, scene, camera) - single
    return Components(reduced, single, image - reduced - single)


def _image(light_field: LightField, scene: Scene, camera: Camera, given: Tensor | None) -> Tensor:
    """Radiance [3, h, w]: E2.1, averaged over the rays of each pixel.

    Behind the volume is what is `given` [C, h, w], else the lights.
    """
    sight = look_through(camera, scene.volume.grid, scene.render)
    samples = scene.render.samples_per_pixel
    behind = None
    if given is not None:
        behind = given.expand(-1, *camera.size).flatten(1).repeat(1, samples)
    elif scene.render.background:
        behind = _background(scene.lights, sight.rays)
    radiance = march(_emission(light_field, sight.rays), sight, scene.render, behind)
    if samples > 1:
        radiance = radiance.unflatten(-1, (samples, -1)).mean(-2)
    return radiance.expand(3, -1).unflatten(-1, camera.size)


def _emission(light_field: LightField, bundle: Rays) -> Emission:
    """What the medium sends towards the camera of `bundle` (E2.2, E2.3, E2.11)."""
    medium = light_field.medium
    diffuse = scatter_towards(medium, light_field.diffuse, bundle, light_field.turned)
    if light_field.skies:
        towards = bundle.towards_eye(medium.grid)
        diffuse = diffuse + scatter_sky(medium, light_field.skies, towards)
    return Emission(
        medium.grid,
        medium.extinction,
        medium.scattering,
        light_field.beams,
        diffuse,
        medium.seen,
        medium.peak,
        medium.remaining if medium.is_cellwise else None,
        medium.support,
        medium.emission,
    )


def _background(lights: Sequence[Light], bundle: Rays) -> Tensor | None:
    """The radiance [C, R] of ambient light and environment maps along `bundle`, unattenuated.

    None where there is no such light.
    """
    environments = [light for light in lights if isinstance(light, EnvironmentLight)]
    if not environments and not any(isinstance(light, AmbientLight) for light in lights):
        return None
    total = ambient_radiance(lights, bundle.direction).view(-1, 1)
    for light in environments:
        total = total + environment_radiance(light, bundle.direction)
    return total
