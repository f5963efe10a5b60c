"""All light inside a medium: uncollided, that is not yet scattered, and collided.

Only the terms that a scene needs are composed: no diffusion solve when the model is `none` or
nothing scatters nor reflects, no quadrature over directions unless unscattered ambient light is
asked for by itself, no fluxes Q1 and L1 when g = 0, one color when all is gray.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import torch
from torch import Tensor

from ddrecon.diffusion.cells import average_cells
from ddrecon.diffusion.closures import Closure, smooth
from ddrecon.diffusion.conservative import DiffusionProblem, solve_conservative
from ddrecon.diffusion.implicit import SolveMemory, SolverWithMemory
from ddrecon.diffusion.paper import (
    iterate_jacobi,
    iterate_picard,
    solve_flux_limited,
    solve_printed,
)
from ddrecon.diffusion.solve import name_kernels, solve_by_multigrid
from ddrecon.light.beam import Beam
from ddrecon.light.lights import AmbientLight
from ddrecon.light.moments import Cut, add, cut, weigh
from ddrecon.light.pairs import ReversedBeam
from ddrecon.light.point_light import PointBeam
from ddrecon.light.reduced import (
    Received,
    ambient_radiance,
    ambient_sky,
    follow_lights,
    receive_light,
    sum_unscattered_sky,
)
from ddrecon.light.sky import Sky, Source
from ddrecon.march.faces import receive_at_faces
from ddrecon.march.ground import LitGround
from ddrecon.march.integral import HALO
from ddrecon.medium.coefficients import (
    Medium,
    Volume,
    keep_medium,
    refine_medium,
    remaining_moments,
    resample,
    scale_medium,
)
from ddrecon.numerics.autodiff import is_varied
from ddrecon.numerics.layout import Unrolled, unroll
from ddrecon.numerics.remember import is_any_nonzero
from ddrecon.settings import DiffusionSettings
from ddrecon.transport.mirror import reflected_light
from ddrecon.transport.rounds import face_mirror, run_rounds, sweep_emission
from ddrecon.transport.sweep import DIRECTIONS


@dataclass(frozen=True)
class FaceLight:
    """What transport rounds know of light at faces (E2.17): `outside` [C, 1, 1, 1], the radiance
    that enters there, and `source` [C, S], what `receive_at_faces` of the wide grid finds of Q0 and
    Q1 of light from beams.
    """

    outside: Tensor
    source: Tensor


@dataclass(frozen=True)
class LightField:
    """All light inside a medium.

    `beams`: unscattered light of directional and point lights (E2.2), of which cells `received`
    some. `diffuse` [K, C, z, y, x]: phi of scattered and emitted light (E2.4, E2.10), and of the
    unscattered light of a ground, of beams that faces have reflected (E5.8), and of skies where
    light scatters more than once or evenly. It is that at cells' centers; after transport rounds,
    which know light `at_faces` as well, it is the mean in cells, and rays see it sharpened.

    `skies`: those whose unscattered light `diffuse` lacks; each camera integrates it by the exact
    phase function. `turned`: light that backward peaks have turned (E8.11). `leaving`
    [K, C, z, y, x]: phi of light that is seen at faces that refract, without that of beams they
    have reflected; None without refraction. `ground`: what lies below, None for nothing.
    """

    medium: Medium
    beams: tuple[Beam | PointBeam, ...]
    received: Received
    diffuse: Tensor
    skies: tuple[Sky, ...] = ()
    turned: tuple[ReversedBeam, ...] = ()
    at_faces: FaceLight | None = None
    leaving: Tensor | None = None
    ground: LitGround | None = None

    def unrolled(self) -> tuple[Unrolled, LightField]:
        """What view rays meet on their way through one period of the medium."""
        period = unroll(self.medium.grid, HALO)
        if not self.medium.grid.periodic:
            return period, self
        wide = replace(
            self,
            medium=self.medium.put(period.wide, period.extend),
            beams=tuple(replace(beam, mass=period.extend(beam.mass)) for beam in self.beams),
            diffuse=period.extend(self.diffuse),
            turned=tuple(replace(b, radiance=period.extend(b.radiance)) for b in self.turned),
        )
        return period, wide


def medium_of(volume: Volume, settings: DiffusionSettings) -> Medium:
    """The medium of `volume`, without its forward peak where light scatters more than once."""
    medium = scale_medium(volume, settings.angles)
    return medium if multiply_scatters(medium, settings) else keep_medium(volume)


def multiply_scatters(medium: Medium, settings: DiffusionSettings) -> bool:
    """Whether light may go on in another direction more than once.

    It may where the model is not `none`, and faces reflect it inside, or sigma_s is not 0 or is
    being differentiated.
    """
    scale = medium.scattering.scale
    may_turn = medium.index != 1 or is_varied(scale) or is_any_nonzero(scale)
    return settings.model != "none" and may_turn


def find_light(
    medium: Medium,
    lights: Sequence[Source],
    settings: DiffusionSettings,
    memory: SolveMemory,
    below: Tensor | None = None,
) -> LightField:
    """The light of `lights` in a `medium_of` a volume, in cells as `settings` refine them.

    `below` [K, C, z, y, x] is phi of a ground's unscattered light, on any grid of the box.
    """
    is_diffuse = multiply_scatters(medium, settings)
    medium = refine_medium(medium, settings.times, settings.refine_along)
    medium = replace(medium, halved=settings.halved)
    # The paper's own scheme knows values at centers only.
    cells = medium if settings.scheme == "printed" else average_cells(medium)
    # Light not yet scattered that is no beam: of a ground, and of beams that faces reflect (E5.8).
    reflected = reflected_light(cells, lights, medium.degree) if medium.index != 1 else None
    unscattered = [] if below is None else [resample(below, medium.grid)]
    unscattered += [] if reflected is None else [reflected]
    if is_diffuse:
        light_field = _scatter_light(medium, cells, lights, unscattered, settings, memory)
    else:
        light_field = _follow_light(medium, cells, lights, unscattered)
    if reflected is None:
        return light_field
    sky = sum_unscattered_sky(medium, light_field.skies, 0)
    leaving = [light_field.diffuse, -reflected, *([] if sky is None else [sky])]
    return replace(light_field, leaving=reduce(add, leaving))


def _scatter_light(
    medium: Medium,
    cells: Medium,
    lights: Sequence[Source],
    unscattered: list[Tensor],
    settings: DiffusionSettings,
    memory: SolveMemory,
) -> LightField:
    """Light that scatters any number of times; `cells` are means of `medium`.

    `unscattered`: phi [K, C, z, y, x] of light besides that of `lights`.
    """
    name_kernels(medium.extinction.field)
    # Q0 and Q1 are the first-collision source; skies' mean enters through the faces (E2.6).
    received = receive_in_parts(medium, cells, lights, settings)
    sky = sum_unscattered_sky(cells, lights, cells.degree)
    unscattered = unscattered if sky is None else [sky, *unscattered]
    scattering = (weigh(light, remaining_moments(cells)) for light in unscattered)
    source = cut(reduce(add, scattering, received.source))
    # As it is where faces do not refract: what is known of a tensor is not known of its product.
    ambient = ambient_radiance(lights, cells.g)
    outside = ambient if medium.index == 1 else medium.index**2 * ambient
    # L0 and L1: E2.4 to E2.6.
    scattered = solve_diffuse(cells, source, outside, settings, memory)
    period = unroll(medium.grid, HALO)
    received_there = receive_at_faces(period.wide, period.extend(cut(received.source)[0]))
    # Light of `unscattered` scatters by E2.3 as well; beams by E2.2 on each view ray.
    return LightField(
        medium,
        follow_lights(medium, lights),
        received,
        reduce(add, unscattered, scattered),
        turned=received.turned,
        at_faces=FaceLight(outside, received_there) if settings.rounds else None,
    )


def receive_in_parts(
    medium: Medium, cells: Medium, lights: Sequence[Source], settings: DiffusionSettings
) -> Received:
    """What `cells`, the means of `medium`, receive of `lights`, in parts by `settings` (E5.10)."""
    finer = refine_medium(medium, settings.receive or 1)
    narrow = None if finer is medium else average_cells(finer)
    return receive_light(cells, lights, cells.degree, narrow)


def _follow_light(
    medium: Medium, cells: Medium, lights: Sequence[Source], unscattered: list[Tensor]
) -> LightField:
    """Light that is not scattered twice; arguments are as of `_scatter_light`.

    Ambient light and skies are followed by quadrature over directions.
    """
    beams, received = follow_lights(medium, lights), receive_light(cells, lights, 0)
    skies = tuple(light for light in lights if isinstance(light, Sky))
    if any(isinstance(light, AmbientLight) for light in lights):
        skies = (*skies, ambient_sky(ambient_radiance(lights, medium.g)))
    if not medium.is_anisotropic:
        # Where all scatter evenly, moments of degree 0 say it all, for all cameras.
        sky, skies = sum_unscattered_sky(medium, skies, 0), ()
        unscattered = unscattered if sky is None else [*unscattered, sky]
    nothing = torch.zeros_like(medium.extinction.value)[None]
    return LightField(medium, beams, received, reduce(add, unscattered or [nothing]), skies)


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
    if settings.is_conservative_p1:
        solve = SolverWithMemory(solve_by_multigrid, settings.tolerance, memory)
        closure = Closure(settings.closure, medium.grid)
        problem = DiffusionProblem(medium, closure, source[0], outside, medium.degree > 0)
        light = solve_conservative(problem, solve)
        counts = settings.rounds, settings.angles, settings.transport_tolerance or 0.0
        return run_rounds(problem, source[1], light, solve, *counts)
    scattered = medium.remaining_scattering * source[0]
    if medium.emission is not None:
        scattered = add(scattered, medium.emission[None])
    if settings.model == "flux_limited":
        solve = SolverWithMemory(iterate_picard, settings.tolerance, memory)
        return solve_flux_limited(medium, scattered, outside, solve, medium.has_flux)
    solve = SolverWithMemory(iterate_jacobi, settings.tolerance, memory)
    diffusion = smooth(medium.transport_extinction, medium.grid)
    return solve_printed(medium, diffusion, scattered, outside, solve, medium.has_flux)


def fluence_of(light_field: LightField, settings: DiffusionSettings) -> Tensor:
    """The fluence [C, z, y, x] >= 0, averaged over each cell of the medium (E5.6)."""
    medium = light_field.medium
    mean = light_field.diffuse[0] + light_field.received.mean
    sky = sum_unscattered_sky(medium, light_field.skies, 0)
    mean = mean if sky is None else mean + sky[0]
    if medium.emission is not None and not multiply_scatters(medium, settings):
        cells, directions = average_cells(medium), DIRECTIONS[settings.angles]
        emitted, _ = sweep_emission(cells, directions, face_mirror(cells, directions))
        mean = mean + emitted[0]
    return 4 * math.pi * mean.clamp(min=0)
