"""What a scene file gets where it leaves something out: colors that are equal, transport rounds."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, get_args

from ddrecon.grid import Triple
from ddrecon.march.samplers import greatest_depth
from ddrecon.medium.coefficients import Volume
from ddrecon.medium.phase import PhaseFunction
from ddrecon.scene_file.read import type_hints
from ddrecon.scene_file.schema import SceneTree
from ddrecon.settings import DiffusionSettings
from ddrecon.variables.kinds import PAIRS, PHASE, split_name

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


def share_colors(tree: SceneTree) -> SceneTree:
    """`tree` with one number for each color whose three are equal, but for what is optimized."""
    return replace(
        tree,
        volume=_share(tree, tree.volume, ""),
        lights=_share(tree, tree.lights, "lights."),
        views=tuple(_share(tree, view, f"views.{view.name}.") for view in tree.views),
    )


def may_change(tree: SceneTree, name: str) -> bool:
    """Whether the variable `name` is optimized, or follows from others that are."""
    medium, last = split_name(tree.own_name(name))
    names = {medium + last, re.sub(r"^views\..*\.", "views.*.", name)}
    others = [pair for pair in PAIRS if last not in pair]
    if len(others) == 1:
        names |= {medium + other for other in others[0]}
    return not names.isdisjoint(tree.optimize.parameters if tree.optimize else ())


def _share(tree: SceneTree, value: Any, owner: str) -> Any:
    """`value` of `tree`, names in which begin with `owner`, with equal colors as one number."""
    if isinstance(value, Mapping):
        return {name: _share(tree, one, f"{owner}{name}.") for name, one in value.items()}
    if isinstance(value, tuple):
        return tuple(_share(tree, one, f"{owner}{index}.") for index, one in enumerate(value))
    if not is_dataclass(value) or isinstance(value, type):
        return value
    shared = {}
    for field in fields(value):
        one, name = getattr(value, field.name), owner + field.name
        is_color = isinstance(one, tuple) and field.name in _colors_of(type(value))
        is_equal = is_color and len(set(one)) == 1 and not may_change(tree, name)
        shared[field.name] = one[0] if is_equal else _share(tree, one, f"{name}.")
    return replace(value, **shared)


@functools.cache
def _colors_of(kind: type) -> set[str]:
    """The fields of records of this `kind` that are a number or three."""
    hints = type_hints(kind).items()
    return {name for name, hint in hints if {float, Triple} <= set(get_args(hint))}
