"""How work that takes long shows how far it is: whoever asks for it hands in what shows it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

Progress = Callable[[Sequence[Any], str], Iterable[Any]]
"""`progress(items, what)` gives the `items` one by one, and shows that `what` is being done."""


def bar_room() -> tuple[int | None, int | None]:
    """Columns and rows for a progress bar; None leaves them to tqdm, which asks the terminal.

    A terminal that says it has none, as some containers' do, would see nothing at all.
    """
    try:
        columns, rows = os.get_terminal_size(sys.stderr.fileno())
    except (OSError, ValueError, AttributeError):
        return None, None
    return (None if columns else 80), (None if rows else 24)


def bar_settings(is_quiet: bool) -> dict[str, Any]:
    """How every progress bar is shown: on stderr, with room, and not at all if `is_quiet`."""
    columns, rows = bar_room()
    return {"file": sys.stderr, "disable": is_quiet, "ncols": columns, "nrows": rows}
