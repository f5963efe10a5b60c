"""The light of a scene: in its volume, to and fro between that and a ground, and along rays."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.cameras import Rays
from ddrecon.defaults import MOST_EXCHANGES
from ddrecon.diffusion.cells import average_cells, sharpen
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.grid import Cells, Grid
from ddrecon.light.ground import Plane, light_from_below, stay_above
from ddrecon.light.moments import fill, floored
from ddrecon.light.outgoing import scatter_once_more, scatter_towards, sum_turned
from ddrecon.light.reduced import ambient_radiance, scatter_sky
from ddrecon.light.sky import decompose_lights
from ddrecon.light_field import LightField, find_light, fluence_of, medium_of, multiply_scatters
from ddrecon.march.faces import scatter_back
from ddrecon.march.ground import light_evenly, light_texels, reflect, upwards
from ddrecon.march.outgoing import Inflow, OutgoingLight, light_up
from ddrecon.medium.coefficients import Medium, resample, volume_at_level
from ddrecon.medium.optics import transmitted_moments
from ddrecon.numerics.autodiff import recompute
from ddrecon.numerics.layout import Unrolled
from ddrecon.numerics.sphere import harmonics
from ddrecon.scene import Scene, require_supported

MOST_CELLS = 32
"""Cells along the longest side, at most, where light goes to and fro between volume and ground."""
BESIDE = 1
"""Cells of the volume's grid beyond its medium, where light does so."""


def solve_light(scene: Scene, memory: SolveMemory) -> LightField:
    """The light inside the volume of `scene`: uncollided and collided (E2.4, E2.5).

    With a ground, whose light is another source, it begins with light that goes to and fro on a
    coarse grid (E5.4).
    """
    require_supported(scene)
    medium, settings = medium_of(scene.volume, scene.diffusion), scene.diffusion
    sources, ground = decompose_lights(scene.lights), scene.ground
    if ground is None:
        return find_light(medium, sources, settings, memory)
    plane, sources = ground.plane, stay_above(sources, ground.plane)
    grid, cells = exchange_grid(scene)
    thin = medium_of(volume_at_level(scene.volume, grid, cells), settings)
    ambient = ambient_radiance(sources, thin.g).flatten()
    from_below = light_from_below(average_cells(thin), plane, ambient)
    lit = light_evenly(ground, sources, thin.grid, ambient)
    for _ in range(scene.exchanges or (MOST_EXCHANGES if thin.grid.periodic else 1)):
        up = from_below(*reflect(lit, thin, scene.render))
        first = find_light(thin, sources, replace(settings, refine=1), replace(memory, last={}), up)
        down = partial(send_down, first, plane, multiply_scatters(thin, settings))
        lit = light_texels(lit, sources, thin, down, scene.render)
    sent = reflect(lit, thin, scene.render)
    below = _spread(from_below(*sent), medium.grid, cells)
    light_field = find_light(medium, sources, settings, memory, below)
    return replace(light_field, ground=replace(lit, sent=sent))


def _spread(light: Tensor, grid: Grid, cells: Cells) -> Tensor:
    """`light` [K, C, z, y, x] of these `cells` of `grid`, in all of them as in the nearest."""
    light = resample(light, grid.cut(cells))
    ends = [(at.start, count - at.stop) for at, count in zip(cells, grid.shape, strict=True)]
    z, y, x = ends
    return pad(light, (*x, *y, *z), mode="replicate") if any(map(any, ends)) else light


def exchange_grid(scene: Scene) -> tuple[Grid, Cells]:
    """The coarser grid on which the volume of `scene` and its ground light each other (E5.4).

    And the cells of the volume's grid along z, y and x that it spans: those around its medium.
    """
    grid = scene.volume.grid
    occupied = scene.occupied or ((0.0,) * 3, (1.0,) * 3)

    def span(axis: int) -> slice:
        count = grid.shape[axis]
        first, last = (round(place[axis] * count) for place in occupied)
        return slice(max(first - BESIDE, 0), min(last + BESIDE, count))

    cells = span(0), span(1), span(2)
    around = grid.cut(cells)
    return around.coarsen(max(1.0, max(around.shape) / MOST_CELLS)), cells


def fluence(scene: Scene, memory: SolveMemory | None = None) -> Tensor:
    """The fluence [C, z, y, x] of all light inside the volume of `scene`: E5.6.

    Differentiable as `render`, and `memory` as there.
    """
    light_field = solve_light(scene, memory or SolveMemory())
    return resample(fluence_of(light_field, scene.diffusion), scene.volume.grid)


def send(
    light_field: LightField, rays: Rays, unrolled: tuple[Unrolled, LightField] | None = None
) -> OutgoingLight:
    """What the medium sends along `rays` towards their camera (E2.2, E2.3, E2.11).

    `unrolled`: that of `light_field`, where it is known.
    """
    period, wide = unrolled or light_field.unrolled()
    medium, sky = wide.medium, None
    if light_field.skies:
        towards = rays.towards_eye(medium.grid)
        sky = scatter_sky(light_field.medium, light_field.skies, towards, period)
    diffuse = scatter_towards(medium, wide.diffuse, rays, wide.turned, sky)
    is_periodic = bool(light_field.medium.grid.periodic)
    unlit = OutgoingLight(
        medium.grid,
        medium.extinction,
        medium.scattering,
        (),
        diffuse if wide.at_faces is None else sharpen(medium, diffuse),
        medium.seen,
        medium.peak,
        medium.remaining if medium.is_cellwise else None,
        medium.support,
        medium.emission,
        period=period if is_periodic else None,
        inflow=_find_inflow(wide, rays),
    )
    outgoing = light_up(unlit, wide.beams)
    if not is_periodic:
        return outgoing

    def from_eye(eye: Tensor) -> OutgoingLight:
        return send(light_field, replace(rays, eye=eye), (period, wide))

    depends_on_eye = len(light_field.diffuse) > 1 or light_field.skies
    return replace(outgoing, from_eye=from_eye if depends_on_eye else None)


def _find_inflow(light_field: LightField, rays: Rays) -> Inflow | None:
    """What comes in through faces, as seen along `rays` (E2.17)."""
    faces, medium = light_field.at_faces, light_field.medium
    if faces is None:
        return None
    # Faces let out and in a part only of what goes through.
    back = transmitted_moments(medium.index)[0] * scatter_back(medium, rays)
    return Inflow(faces.outside, faces.source, _unpeaked_share(medium), back)


def _unpeaked_share(medium: Medium) -> Tensor:
    """1 - f, the share of scattering without its forward peak; where that differs by cell, 1."""
    fraction = medium.forward_fraction
    return torch.ones_like(medium.g.view(-1)[:1]) if medium.is_cellwise else 1 - fraction


def send_down(
    light_field: LightField, plane: Plane, is_diffuse: bool, bundles: Sequence[Rays]
) -> OutgoingLight:
    """What the medium sends down to a ground, along `bundles` of rays into directions `upwards`.

    Its `diffuse` light is that along one bundle after another, [N C, z, y, x]. Where light
    `is_diffuse`, beams count by what cells receive of them: that leaves out their forward peak,
    which the ground receives as direct light.
    """
    if not is_diffuse:
        sent = [send(light_field, rays) for rays in bundles]
        return replace(sent[0], diffuse=torch.cat([light.diffuse for light in sent]))
    period, wide = light_field.unrolled()
    light, degree = scatter_once_more(wide.medium, wide.diffuse), wide.medium.degree
    values = harmonics(-upwards(plane)[0], degree).T.to(light)
    diffuse = torch.tensordot(values, fill(light, degree), 1)
    if wide.turned:
        turned = [sum_turned(wide.medium, rays, wide.turned) for rays in bundles]
        diffuse = diffuse + torch.stack(turned)
    diffuse = recompute(floored, diffuse, light[0], len(light) > 1)
    if wide.at_faces is not None:
        diffuse = sharpen(wide.medium, diffuse.flatten(0, 1)).unflatten(0, (len(bundles), -1))
    received = torch.tensordot(values, fill(light_field.received.source, degree), 1)
    received = _unpeaked_share(light_field.medium) * received
    diffuse = (diffuse + period.extend(received)).flatten(0, 1)
    beamless = replace(light_field, beams=(), at_faces=None)
    return replace(send(beamless, bundles[0]), diffuse=diffuse)
