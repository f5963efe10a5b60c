"""How many transport rounds a scene file gets, and of which degree, where it leaves that out."""

from __future__ import annotations

from dataclasses import replace

from ddrecon.march.steps import greatest_depth
from ddrecon.medium.coefficients import Volume
from ddrecon.medium.phase import PhaseFunction
from ddrecon.scene_file.schema import SceneTree
from ddrecon.settings import DiffusionSettings
from ddrecon.variables.kinds import PHASE

MORE_ROUNDS = 0.3, 0.6
"""A second moment of the phase function above one of these deserves a round more: by about so much
a round multiplies what is left. For Henyey-Greenstein that is a |g| of 0.55 and 0.77.
"""
FEW_ANGLES = 0.1
"""A second moment up to this needs no angles beyond diffusion's; |g| is up to 0.32 then."""
THICK = 2.0
"""Where a cell has more optical depths and light is scattered forward, one round of two moments is
nearer to the truth than any of more: what is not scaled out as a peak has to cross the cell. Only
where the phase function is given.
"""
SOUGHT = 0.31
"""The second moment that stands for a phase function which is sought: two rounds."""


def choose_rounds(
    tree: SceneTree, phase: PhaseFunction, volume: Volume | None = None
) -> DiffusionSettings:
    """The diffusion settings of `tree`, with rounds and degree as `phase` deserves if left out.

    A phase function that is sought may become any: it starts as one of strong peaks does. `volume`:
    None where it is not known yet; fewer rounds and moments may do in it.
    """
    settings = tree.diffusion
    if not settings.rounds:
        return settings
    moments = phase.moments(3)
    left = float(moments[:, 2].abs().max())
    is_forward = float(moments[:, 1].min()) > 0 and not bool(phase.backward_tail(1, 1).any())
    sought = tree.optimize.parameters if tree.optimize else {}
    if any(name == "g" or name.startswith(PHASE) for name in sought):
        left = max(left, SOUGHT)
    elif is_forward and volume is not None and greatest_depth(volume) > THICK:
        left = 0.0
    rounds, degree = 1 + sum(left > bound for bound in MORE_ROUNDS), 3 if left > FEW_ANGLES else 1
    return replace(
        settings,
        transport_rounds=rounds if settings.transport_rounds is None else settings.transport_rounds,
        degree=degree if settings.degree is None else settings.degree,
    )
