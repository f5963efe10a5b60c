"""How light that a backward peak has turned is scattered once more, towards a camera (E21)."""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.angle_table import STEPS
from ddrecon.numerics.legendre import COUNTS, legendre_at_even_angles, series_weights
from ddrecon.numerics.remember import remember

NEGLIGIBLE = 1e-7
"""Moments below this are left out."""


def turned_phase(medium: Medium, degree: int, turns: int) -> Tensor:
    """The phase function of E21 as a table [C, steps + 1, 2, 1] over the angle, for `look_up`.

    The angle is that from the way the turned light goes. Its moments are chi_l up to `degree`, and
    chi_l r_l^turns beyond, r_l being those of the backward peak.
    """
    return _turned_phase(medium.g, degree, turns)


@remember
def _turned_phase(g: Tensor, degree: int, turns: int) -> Tensor:
    largest = float(g.detach().abs().max()) ** (1 + turns)
    count = next((some for some in COUNTS if largest**some < NEGLIGIBLE), COUNTS[-1])
    power = torch.arange(count, dtype=torch.float64, device=g.device)
    beyond = (power - degree - 1).clamp(min=0)
    g = g.reshape(-1, 1).double()
    # r_l = |g|^(l - L - 1) beyond L: of a Henyey-Greenstein peak
    moments = g**power * (-g) ** (turns * beyond)
    curves = legendre_at_even_angles(STEPS, count)
    weights = series_weights(moments)
    return torch.stack([weights @ rows.to(weights).T for rows in curves], -1)[..., None]
