"""How work that takes long shows how far it is: whoever asks for it hands in what shows it."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

Progress = Callable[[Sequence[Any], str], Iterable[Any]]
"""`progress(items, what)` gives the `items` one by one, and shows that `what` is being done."""


def bar_settings(is_quiet: bool) -> dict[str, Any]:
    """How every progress bar is shown: on stderr, and not at all if `is_quiet`.

    A terminal that says it has no room, as some containers' do, gets 80 columns and 24 rows.
    """
    columns, rows = shutil.get_terminal_size()
    return {"file": sys.stderr, "disable": is_quiet, "ncols": columns - 1, "nrows": rows}
