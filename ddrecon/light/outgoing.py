"""What one more scattering makes of light inside a medium: E2.3, towards a camera."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.light.moments import floored, radiance_along, weigh
from ddrecon.light.pairs import ReversedBeam
from ddrecon.medium.coefficients import Medium, remaining_moments, turned_in_cells, turned_table
from ddrecon.numerics.autodiff import is_fused, recompute
from ddrecon.numerics.remember import remember
from ddrecon.numerics.series import angle_of, look_up


def scatter_once_more(medium: Medium, light: Tensor) -> Tensor:
    """(1 - f) p_l phi_k of `light` phi, per unit length and kappa_s (E2.3, E8.12).

    Where the phase function differs from cell to cell it is p_l phi_k, per (1 - f) kappa_s.
    """
    return weigh(light, _factors(medium))


def _factors(medium: Medium) -> Tensor:
    """(1 - f) p_l, or p_l, by the degree l."""
    moments = remaining_moments(medium)
    return moments if medium.is_cellwise else _lessen(moments, medium.forward_fraction)


@remember
def _lessen(moments: Tensor, fraction: Tensor) -> Tensor:
    return (1 - fraction) * moments


def scatter_towards(
    medium: Medium,
    light: Tensor,
    rays: Rays,
    turned: Sequence[ReversedBeam] = (),
    more: Tensor | None = None,
) -> Tensor:
    """The radiance >= 0 `[C, z, y, x]` of `scatter_once_more` towards the camera of `rays`.

    What the `turned` beams scatter (E8.12), or `more` of skies, is added; the sum is `floored`.
    """
    more = recompute(sum_turned, medium, rays, turned) if turned else more
    if is_fused() and len(light) > 1 and not medium.is_cellwise and rays.pane is None:
        from ddrecon.light.fused.outgoing import scatter_fused

        return scatter_fused(medium.grid, light, _factors(medium), rays, more)

    def scatter() -> Tensor:
        sent = scatter_once_more(medium, light)
        if len(sent) == 1:
            return floored(sent[0] if more is None else sent[0] + more, sent[0], is_directed=False)
        return radiance_along(sent, rays.towards_eye(medium.grid), more)

    return recompute(scatter)


def sum_turned(medium: Medium, rays: Rays, turned: Sequence[ReversedBeam]) -> Tensor:
    """What light of all `turned` beams scatters towards the camera of `rays`."""
    towards = rays.towards_eye(medium.grid)
    return functools.reduce(torch.add, (_scatter_turned(medium, beam, towards) for beam in turned))


def _scatter_turned(medium: Medium, beam: ReversedBeam, towards: Sequence[Tensor]) -> Tensor:
    """What light of `beam` scatters `towards` a camera (E8.12), per unit of `scatter_once_more`."""
    z, y, x = (a * b for a, b in zip(beam.direction, towards, strict=True))
    cosine = torch.atleast_3d(z + y + x)
    if medium.is_cellwise:
        phase = turned_in_cells(medium, beam.turns, angle_of(cosine))
        return beam.radiance * phase / (1 - medium.forward_fraction)
    table = turned_table(medium.seen.phase, medium.seen.degree, beam.turns)
    return beam.radiance * look_up(table, angle_of(cosine))[..., 0].to(cosine.dtype)
