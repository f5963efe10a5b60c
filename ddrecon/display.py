"""How records show themselves in a notebook: as what a room above them draws.

The package itself says who that is (`draw_by`), so that no record knows of pages.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_drawers: list[Callable[[Any], str]] = []


def draw_by(draw: Callable[[Any], str]) -> None:
    """Has `draw` make the HTML of every record from now on."""
    _drawers[:] = [draw]


class Displayed:
    """A record that notebooks show as HTML."""

    def _repr_html_(self) -> str | None:
        """The record as HTML; None, for its plain text, where nobody draws it."""
        return _drawers[0](self) if _drawers else None
