"""What one more scattering makes of light inside a medium: E3, towards a camera."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.light.moments import Moments, Vector
from ddrecon.light.pairs import TurnedBeam
from ddrecon.medium.coefficients import Medium
from ddrecon.medium.remaining import remaining_moments
from ddrecon.medium.turned_phase import turned_phase
from ddrecon.numerics.angle_table import angle_of, look_up
from ddrecon.numerics.autodiff import is_fused, recompute


def scatter_once_more(medium: Medium, light: Moments, degree: int = 1) -> Moments:
    """(1 - f) p_l phi_k as moments to `degree`, per unit length and kappa_s (E3, E21)."""
    kept = 1 - medium.forward_fraction
    if degree <= 1:
        return light.scaled(kept, kept * medium.mean_cosine)
    return light.weighted(kept * remaining_moments(medium, degree))


def scatter_towards(
    medium: Medium,
    light: Moments,
    rays: Rays,
    degree: int = 1,
    turned: Sequence[TurnedBeam] = (),
) -> Tensor:
    """The radiance >= 0 `[C, z, y, x]` of `scatter_once_more` towards the camera of `rays`.

    With what the `turned` beams scatter (E21). As `Moments.positive_along` has it.
    """
    if is_fused() and light.higher is None and not turned:
        from ddrecon.light.fused.outgoing import scatter_fused

        return scatter_fused(medium, light, rays)
    return recompute(_scatter_towards, medium, light, rays, degree, turned)


def _scatter_towards(
    medium: Medium, light: Moments, rays: Rays, degree: int, turned: Sequence[TurnedBeam]
) -> Tensor:
    towards = rays.towards_eye(medium.grid)
    seen = [_scatter_turned(medium, beam, towards, degree) for beam in turned]
    more = functools.reduce(torch.add, seen) if seen else None
    return scatter_once_more(medium, light, degree).positive_along(towards, more)


def _scatter_turned(medium: Medium, beam: TurnedBeam, towards: Vector, degree: int) -> Tensor:
    """What light of `beam` scatters `towards` a camera: its phase function is that of E21."""
    z, y, x = (part * cosine for part, cosine in zip(beam.direction, towards, strict=True))
    table = turned_phase(medium, degree, beam.turns)
    cosine = torch.as_tensor(z + y + x)
    return beam.radiance * look_up(table, angle_of(cosine))[..., 0].to(cosine.dtype)
