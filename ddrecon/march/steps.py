"""How many samples a cell view rays get where a scene file leaves that out."""

from __future__ import annotations

from ddrecon.medium.coefficients import Volume, along_colors

THICK = 0.75
"""Cells of more optical depths than this get two samples along a ray (docs/accuracy.md)."""


def choose_steps(volume: Volume) -> int:
    """Samples a cell that `volume` deserves: 2 where one is optically thick, else 1."""
    return 2 if greatest_depth(volume) > THICK else 1


def greatest_depth(volume: Volume) -> float:
    """The greatest optical depth of a cell of `volume`, of any color, across its mean side."""
    absorbing, scattering = (
        sigma.detach() if sigma.ndim == 4 else along_colors(sigma).detach()
        for sigma in (volume.sigma_a, volume.sigma_s)
    )
    most = (absorbing + scattering).amax(0)
    spacing = volume.grid.spacing
    return float((volume.density.detach() * most).amax()) * sum(spacing) / len(spacing)
