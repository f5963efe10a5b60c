"""How many colors a scene has: what is equal in all three, and stays so, is one number."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, get_args, get_type_hints

from ddrecon.grid import Triple
from ddrecon.scene_file.schema import SceneTree
from ddrecon.variables.kinds import PAIRS, split_name


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
    hints = get_type_hints(kind).items()
    return {name for name, hint in hints if {float, Triple} <= set(get_args(hint))}
