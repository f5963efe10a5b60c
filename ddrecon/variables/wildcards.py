"""Names for all training views at once: `views.*.exposure`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

from ddrecon.scene import View

EVERY = "views.*."
"""How such a name begins."""
Settings = TypeVar("Settings")


def name_each(parameters: Mapping[str, Settings], views: Sequence[View]) -> dict[str, Settings]:
    """`parameters` with each name of all training views replaced by those of each of `views`.

    These are the views to train on that have an image. What a view's own name says wins.
    """
    train = [view.name for view in views if view.image is not None and not view.is_test]
    named: dict[str, Settings] = {}
    for name, settings in parameters.items():
        if not name.startswith(EVERY):
            named[name] = settings
            continue
        key = name.removeprefix(EVERY)
        for owner in (f"views.{view}.{key}" for view in train):
            named[owner] = parameters.get(owner, settings)
    return named
