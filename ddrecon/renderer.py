"""The paper on one page: light not yet scattered, light scattered often, rays that collect both.

`render` composes only the terms that a scene needs: no diffusion solve when the model is `none` or
nothing scatters nor reflects, no quadrature over directions unless unscattered ambient light is
asked for by itself, no fluxes Q1 and L1 when g = 0, one color when all is gray.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from ddrecon.cameras import Camera, Rays
from ddrecon.diffusion.cells import average_cells, sharpen
from ddrecon.diffusion.closures import Closure, smooth
from ddrecon.diffusion.conservative import DiffusionProblem, solve_conservative
from ddrecon.diffusion.flux_limited import iterate_picard, solve_flux_limited
from ddrecon.diffusion.implicit import SolveMemory, SolverWithMemory
from ddrecon.diffusion.printed import iterate_jacobi, solve_printed
from ddrecon.diffusion.solve import name_kernels, solve_by_multigrid
from ddrecon.errors import UsageError
from ddrecon.grid import Grid
from ddrecon.light.beam import Beam
from ddrecon.light.environment import environment_radiance
from ddrecon.light.ground import Plane, light_from_below, stay_above
from ddrecon.light.lights import AmbientLight, EnvironmentLight, Light
from ddrecon.light.moments import Cut, add, cut, fill, floored, weigh
from ddrecon.light.outgoing import scatter_back, scatter_once_more, scatter_towards, sum_turned
from ddrecon.light.pairs import TurnedBeam
from ddrecon.light.point_light import PointBeam
from ddrecon.light.reduced import (
    Received,
    ambient_radiance,
    ambient_sky,
    follow_lights,
    receive_light,
    scatter_sky,
    sum_unscattered_sky,
)
from ddrecon.light.sky import Sky, Source, decompose_lights
from ddrecon.march.ground import LitGround, light_evenly, light_texels, reflect, see_ground, upwards
from ddrecon.march.integral import march
from ddrecon.march.outgoing import Inflow, OutgoingLight, light_up
from ddrecon.march.periods import HALO
from ddrecon.march.sight import look_through
from ddrecon.march.windows import look_inside, see_through
from ddrecon.medium.coefficients import Medium, Volume, keep_medium, scale_medium
from ddrecon.medium.fresnel import transmitted_moments
from ddrecon.medium.levels import refine_medium, resample, volume_at_level
from ddrecon.medium.remaining import remaining_moments
from ddrecon.numerics.autodiff import is_varied, recompute
from ddrecon.numerics.harmonics import harmonics
from ddrecon.numerics.periods import Unrolled, unroll
from ddrecon.numerics.remember import is_any_nonzero
from ddrecon.scene import Scene, View
from ddrecon.settings import DiffusionSettings
from ddrecon.supported import require_supported
from ddrecon.transport.bounced import reflected_light
from ddrecon.transport.rounds import face_mirror, run_rounds, sweep_emission
from ddrecon.transport.sweep import DIRECTIONS

MOST_CELLS = 32
"""Cells along the longest side, at most, where light goes to and fro between volume and ground."""

EXCHANGES = 4
"""How often it does where the volume repeats, and so little of it leaves sideways."""


@dataclass(frozen=True)
class LightField:
    """All light inside a medium.

    `beams` are those of directional and point lights (E2.2), `diffuse` phi of the other light.
    `skies` are those whose light it lacks: they scatter by the exact phase function, into each
    camera's rays anew. `outside` [C, 1, 1, 1] is the radiance that enters through faces, and
    `source` [1 or 4, C, z, y, x] are moments of what is received of beams there, Q0 and Q1; None
    where nothing is known of that. `turned` is light that backward peaks have turned (E8.11).
    `received` is what cells receive of `beams`. After rounds `diffuse` light `has_means` of cells,
    else values at centers. `ground` is what lies below, where there is any. `reflected` is what of
    `diffuse` are beams that faces have reflected (E5.8): no camera looks along these.
    """

    medium: Medium
    beams: tuple[Beam | PointBeam, ...]
    diffuse: Tensor
    received: Received
    has_means: bool = False
    skies: tuple[Sky, ...] = ()
    turned: tuple[TurnedBeam, ...] = ()
    ground: LitGround | None = None
    outside: Tensor | None = None
    source: Tensor | None = None
    reflected: Tensor | None = None

    def unrolled(self) -> tuple[Unrolled, LightField]:
        """What view rays meet on their way through one period of the medium."""
        period = unroll(self.medium.grid, HALO)
        if not self.medium.grid.periodic:
            return period, self
        beams = (replace(beam, mass=period.extend(beam.mass)) for beam in self.beams)
        turned = (replace(one, radiance=period.extend(one.radiance)) for one in self.turned)
        medium = self.medium.put(period.wide, period.extend)
        light = period.extend(self.diffuse)
        source = None if self.source is None else period.extend(self.source)
        wide = replace(self, medium=medium, beams=tuple(beams), diffuse=light, turned=tuple(turned))
        return period, replace(wide, source=source)


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

    Reduced light alone where nothing scatters twice. With a ground, whose light is another source,
    it begins with light that goes to and fro on a coarse grid (E5.4).
    """
    volume, sources, settings = scene.volume, scene_sources(scene), scene.diffusion
    require_supported(scene)
    if scene.ground is None:
        return _find_light(volume, sources, settings, memory)
    coarse = volume_at_level(volume, exchange_grid(volume.grid))
    as_given = replace(settings, refine=1)
    plane, render_settings = scene.ground.plane, scene.render
    medium = _medium_of(coarse, settings)
    ambient = ambient_radiance(sources, medium.g).flatten()
    from_below = light_from_below(average_cells(medium), plane, ambient)
    lit = light_evenly(scene.ground, sources, coarse.grid, ambient)
    for _ in range(EXCHANGES if coarse.grid.periodic else 1):
        begun = from_below(*reflect(lit, medium, render_settings))
        first = _find_light(coarse, sources, as_given, replace(memory, last={}), begun)
        glow = partial(_glow, first, plane, multiply_scatters(medium, settings))
        lit = light_texels(lit, sources, medium, glow, render_settings)
    sent = reflect(lit, medium, render_settings)
    light_field = _find_light(volume, sources, settings, memory, from_below(*sent))
    return replace(light_field, ground=replace(lit, sent=sent))


def exchange_grid(grid: Grid) -> Grid:
    """The coarser grid of a volume on which it and a ground light each other (E5.4)."""
    return grid.coarsen(max(1.0, max(grid.shape) / MOST_CELLS))


def scene_sources(scene: Scene) -> list[Source]:
    """What light comes from in `scene`: of its lights what a ground does not hide."""
    sources = decompose_lights(scene.lights)
    return sources if scene.ground is None else stay_above(sources, scene.ground.plane)


def _medium_of(volume: Volume, settings: DiffusionSettings) -> Medium:
    """As it is, with its forward peak, where light is scattered no more than once."""
    medium = scale_medium(volume, settings.angles)
    return medium if multiply_scatters(medium, settings) else keep_medium(volume)


def _find_light(
    volume: Volume,
    lights: Sequence[Source],
    settings: DiffusionSettings,
    memory: SolveMemory,
    below: Tensor | None = None,
) -> LightField:
    """The light of `lights` in `volume`, and of what comes from `below` on a grid of the box."""
    medium = refine_medium(_medium_of(volume, settings), settings.times, settings.refine_along)
    if below is not None:
        below = resample(below, medium.grid)
    reflected = None
    if medium.index != 1:
        # With what faces reflect inside of light that is not yet scattered (E5.8).
        below = reflected = reflected_light(average_cells(medium), lights, medium.degree)
    if not multiply_scatters(medium, settings):
        return replace(follow_unscattered_light(medium, lights, below), reflected=reflected)
    # The paper's own scheme knows values at centers only.
    cells = medium if settings.scheme == "printed" else average_cells(medium)
    if not medium.grid.periodic:
        name_kernels(medium.extinction.field)
    # Q0 and Q1: beams and skies, not yet scattered; skies' mean enters through the faces (E2.6).
    received = receive_light(cells, lights, cells.degree)
    sky = sum_unscattered_sky(cells, lights, cells.degree)
    if below is not None:
        sky = below if sky is None else add(sky, below)
    source = beamed = cut(received.source)
    if sky is not None:
        source = cut(add(received.source, weigh(sky, remaining_moments(cells))))
    outside = ambient_radiance(lights, cells.g)
    if medium.index != 1:
        outside = medium.index**2 * outside
    # L0 and L1: E2.4 to E2.6.
    diffuse = solve_diffuse(cells, source, outside, settings, memory)
    # Skies scatter by E2.3 as well; beams by E2.2 on each view ray.
    light = diffuse if sky is None else add(diffuse, sky)
    beams, has_means = follow_lights(medium, lights), settings.rounds > 0
    found = LightField(medium, beams, light, received, has_means, turned=received.turned)
    if not has_means:
        return replace(found, reflected=reflected)
    return replace(found, outside=outside, source=beamed[0], reflected=reflected)


def follow_unscattered_light(
    medium: Medium, lights: Sequence[Source], below: Tensor | None = None
) -> LightField:
    """The light inside `medium` that has not been scattered.

    Beams, and by quadrature over directions ambient light, skies and what comes from `below`.
    """
    beams, received = follow_lights(medium, lights), receive_light(average_cells(medium), lights, 0)
    skies = tuple(light for light in lights if isinstance(light, Sky))
    if any(isinstance(light, AmbientLight) for light in lights):
        skies = (*skies, ambient_sky(ambient_radiance(lights, medium.g)))
    light = torch.zeros_like(medium.extinction.value)[None] if below is None else below
    if medium.is_anisotropic:
        return LightField(medium, beams, light, received, skies=skies)
    sky = sum_unscattered_sky(medium, skies, 0)
    light = light if sky is None else add(light, sky)
    return LightField(medium, beams, light, received)


def fluence(scene: Scene, memory: SolveMemory | None = None) -> Tensor:
    """The fluence [C, z, y, x] of all light inside the volume of `scene`: E5.6.

    Differentiable as `render`, and `memory` as there.
    """
    light_field = solve_light(scene, memory or SolveMemory())
    return resample(fluence_of(light_field, scene.diffusion), scene.volume.grid)


def fluence_of(light_field: LightField, settings: DiffusionSettings) -> Tensor:
    """The fluence [C, z, y, x] >= 0, averaged over each cell of the medium."""
    medium = light_field.medium
    mean = light_field.diffuse[0] + light_field.received.mean
    sky = sum_unscattered_sky(medium, light_field.skies, 0)
    mean = mean if sky is None else mean + sky[0]
    if medium.emission is not None and not multiply_scatters(medium, settings):
        cells, directions = average_cells(medium), DIRECTIONS[settings.angles]
        mean = mean + sweep_emission(cells, directions, face_mirror(cells, directions))[0]
    return 4 * math.pi * mean.clamp(min=0)


def _glow(
    light_field: LightField, plane: Plane, has_source: bool, bundles: Sequence[Rays]
) -> OutgoingLight:
    """What the medium sends down to a ground, along `bundles` of rays into directions `upwards`.

    Its `diffuse` light is that along one bundle after another, [N C, z, y, x]. Beams count by what
    cells receive of them where it `has_source`: that leaves out their forward peak, which the
    ground receives as direct light.
    """
    if not has_source:
        each = [_outgoing(light_field, rays) for rays in bundles]
        return replace(each[0], diffuse=torch.cat([one.diffuse for one in each]))
    period, wide = light_field.unrolled()
    light, degree = scatter_once_more(wide.medium, wide.diffuse), wide.medium.degree
    values = harmonics(-upwards(plane)[0], degree).T.to(light)
    diffuse = torch.tensordot(values, fill(light, degree), 1)
    if wide.turned:
        diffuse = diffuse + torch.stack([sum_turned(wide.medium, r, wide.turned) for r in bundles])
    diffuse = recompute(floored, diffuse, light[0], len(light) > 1)
    if light_field.has_means:
        diffuse = sharpen(wide.medium, diffuse.flatten(0, 1)).unflatten(0, (len(bundles), -1))
    scattered = torch.tensordot(values, fill(light_field.received.source, degree), 1)
    if not wide.medium.is_cellwise:
        scattered = (1 - wide.medium.forward_fraction) * scattered
    diffuse = (diffuse + period.extend(scattered)).flatten(0, 1)
    others = replace(light_field, beams=(), outside=None)
    return replace(_outgoing(others, bundles[0]), diffuse=diffuse)


def multiply_scatters(medium: Medium, settings: DiffusionSettings) -> bool:
    """Whether light may go on in another direction more than once.

    It may where the model is not `none`, and faces reflect it inside, or sigma_s is not 0 or is
    being differentiated.
    """
    scale = medium.scattering.scale
    may_turn = medium.index != 1 or is_varied(scale) or is_any_nonzero(scale)
    return settings.model != "none" and may_turn


def solve_diffuse(
    medium: Medium,
    source: Cut,
    outside: Tensor,
    settings: DiffusionSettings,
    memory: SolveMemory,
) -> Tensor:
    """phi of light (E2.4 to E2.6, E2.10), by the scheme of `settings`.

    `source`: moments of Q0 and Q1, and those of higher degree; `outside` [C, 1, 1, 1]: the radiance
    of ambient light.
    """
    if (settings.model, settings.scheme) != ("p1", "conservative"):
        scattering = medium.remaining_scattering
        scattered = scattering * source[0]
        if medium.emission is not None:
            scattered = add(scattered, medium.emission[None])
        if settings.model == "flux_limited":
            solve = SolverWithMemory(iterate_picard, settings.tolerance, memory)
            return solve_flux_limited(medium, scattered, outside, solve, medium.has_flux)
        solve = SolverWithMemory(iterate_jacobi, settings.tolerance, memory)
        diffusion = smooth(medium.transport_extinction, medium.grid, settings.floor)
        return solve_printed(medium, diffusion, scattered, outside, solve, medium.has_flux)
    solve = SolverWithMemory(solve_by_multigrid, settings.tolerance, memory)
    closure = Closure(settings.closure, medium.grid, settings.floor)
    problem = DiffusionProblem(medium, closure, source[0], outside, medium.degree > 0)
    light = solve_conservative(problem, solve)
    tolerance = settings.transport_tolerance or 0.0
    return run_rounds(problem, source[1], light, solve, settings.rounds, settings.angles, tolerance)


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
    diffusing = replace(_without_glow(light_field), beams=(), ground=None)
    parts = [
        (_without_diffuse(light_field), scene, camera, behind),
        (diffusing, _without_background(scene), camera, None),
    ]
    varied, fixed = parts if derivatives == "single" else reversed(parts)
    with torch.no_grad():
        rest = _image(*fixed).detach()
    return _image(*varied) + rest


def _without_background(scene: Scene) -> Scene:
    return replace(scene, render=replace(scene.render, background=False))


def _without_glow(light_field: LightField) -> LightField:
    return replace(light_field, medium=replace(light_field.medium, emission=None))


def _without_diffuse(light_field: LightField) -> LightField:
    """What comes in through faces is then what the medium would emit there."""
    outside, nothing = light_field.outside, torch.zeros_like(light_field.diffuse[0])
    given = replace(light_field, diffuse=nothing[None], skies=(), turned=(), reflected=None)
    given = replace(given, outside=None)
    if outside is None or light_field.medium.emission is None:
        return given
    return replace(given, source=nothing[None], outside=torch.zeros_like(outside))


def view_components(light_field: LightField, scene: Scene, camera: Camera) -> Components:
    """The image of `camera` split into its terms; `light_field` must be that of `scene`.

    With forward scattering the image sees the delta-Eddington scaled medium; reduced and single
    radiance are those of the medium itself, and the difference, light scattered forward once or
    more, belongs to `multiple`.
    """
    unscattered = replace(scene, diffusion=replace(scene.diffusion, model="none"))
    once = solve_light(unscattered, SolveMemory())
    image = view_image(light_field, scene, camera)
    single = view_image(
        replace(_without_glow(once), ground=None), _without_background(scene), camera
    )
    reduced = view_image(once, scene, camera) - single
    return Components(reduced, single, image - reduced - single)


def _image(light_field: LightField, scene: Scene, camera: Camera, given: Tensor | None) -> Tensor:
    """Radiance [3, h, w]: E2.1, averaged over the rays of each pixel.

    Behind the volume is the ground, or what is `given` [C, h, w], else the lights.
    """
    samples, medium = scene.render.samples_per_pixel, light_field.medium
    if given is not None:
        given = given.expand(-1, *camera.size).flatten(1).repeat(1, samples)

    def look_behind(rays: Rays, given: Tensor | None) -> Tensor | None:
        if given is None and scene.render.background:
            return _background(scene.lights, rays)
        return given

    if medium.index == 1:
        sight = look_through(camera, medium.grid, scene.render)
        behind = look_behind(sight.rays, given)
        if light_field.ground is not None:
            behind = see_ground(light_field.ground, medium, sight.rays, behind, scene.render)
        radiance = march(_outgoing(light_field, sight.rays), sight, scene.render, behind)
    else:
        rays, windows = look_inside(camera, medium.grid, medium.index, scene.render)
        at_faces, sky = light_field.diffuse, sum_unscattered_sky(medium, light_field.skies, 0)
        at_faces = at_faces if sky is None else add(at_faces, sky)
        if light_field.reflected is not None:
            at_faces = add(at_faces, -light_field.reflected)
        beside = look_behind(rays, given)
        radiance = rays.direction.new_zeros(1, 1) if beside is None else beside
        for window in windows:
            behind = None if given is None else given[:, window.numbers]
            behind = look_behind(Rays(window.points, window.outside, None), behind)
            outgoing = _outgoing(light_field, window.sight.rays)
            seen = see_through(window, outgoing, at_faces, medium, behind, scene.render)
            colors = max(len(radiance), len(seen))
            radiance = radiance.expand(colors, len(rays.direction))
            radiance = radiance.index_copy(1, window.numbers, seen.expand(colors, -1))
        radiance = radiance.expand(-1, len(rays.direction))
    if samples > 1:
        radiance = radiance.unflatten(-1, (samples, -1)).mean(-2)
    return radiance.expand(3, -1).unflatten(-1, camera.size)


def _outgoing(
    light_field: LightField, bundle: Rays, unrolled: tuple[Unrolled, LightField] | None = None
) -> OutgoingLight:
    """What the medium sends towards the camera of `bundle` (E2.2, E2.3, E2.11).

    `unrolled`: that of `light_field`, where it is known.
    """
    period, wide = unrolled or light_field.unrolled()
    medium = wide.medium
    sky = None
    if light_field.skies:
        towards = bundle.towards_eye(medium.grid)
        sky = scatter_sky(light_field.medium, light_field.skies, towards, period)
    diffuse = scatter_towards(medium, wide.diffuse, bundle, wide.turned, sky)
    if light_field.has_means:
        diffuse = sharpen(medium, diffuse)
    is_periodic = bool(light_field.medium.grid.periodic)
    unlit = OutgoingLight(
        medium.grid,
        medium.extinction,
        medium.scattering,
        (),
        diffuse,
        medium.seen,
        medium.peak,
        medium.remaining if medium.is_cellwise else None,
        medium.support,
        medium.emission,
        period=period if is_periodic else None,
        inflow=_inflow(wide, bundle),
    )
    outgoing = light_up(unlit, wide.beams)
    if not is_periodic:
        return outgoing
    depends = len(light_field.diffuse) > 1 or light_field.skies

    def from_eye(eye: Tensor) -> OutgoingLight:
        return _outgoing(light_field, replace(bundle, eye=eye), (period, wide))

    return replace(outgoing, from_eye=from_eye if depends else None)


def _inflow(light_field: LightField, rays: Rays) -> Inflow | None:
    """What comes in through faces, as seen along `rays`."""
    if light_field.outside is None or light_field.source is None:
        return None
    medium = light_field.medium
    kept = (
        torch.ones_like(medium.g.view(-1)[:1])
        if medium.is_cellwise
        else 1 - medium.forward_fraction
    )
    # Faces let out and in a part only of what goes through.
    let_in = transmitted_moments(medium.index)[0]
    back = [let_in * part for part in scatter_back(medium, rays)]
    return Inflow(light_field.outside, light_field.source, kept, back)


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
