"""Progress bars and tables."""

import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from threading import Timer
from typing import Any

from tqdm import tqdm

IN_A_LOG = 30.0
"""Seconds between two states of a bar in a file, each of which is a line there."""
LONG = 2.0
"""Seconds after which `tell` says what is being done."""
BAR = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"
"""The format of a bar that leaves room for a postfix in 80 columns."""


_is_quiet = True
"""Nothing is shown unless a command says otherwise."""


def be_quiet(is_quiet: bool) -> None:
    """Has this process show no progress, or show it."""
    global _is_quiet
    _is_quiet = is_quiet


def bar_settings() -> dict[str, Any]:
    """How every progress bar is shown: on stderr, and not at all where it is quiet.

    A terminal that says it has no room, as some containers' do, gets 80 columns and 24 rows.
    """
    columns, rows = shutil.get_terminal_size()
    settings = {"file": sys.stderr, "disable": _is_quiet, "ncols": columns - 1, "nrows": rows}
    if not sys.stderr.isatty():
        settings |= {"mininterval": IN_A_LOG, "maxinterval": IN_A_LOG}
    return settings


def show_progress(items: Sequence[Any], text: str) -> Iterable[Any]:
    """The `items` one by one, beside a bar of this `text`."""
    return tqdm(items, desc=text, leave=False, **bar_settings())


def say(text: str) -> None:
    """Writes `text` to stderr, above all bars, unless it is quiet."""
    if not _is_quiet:
        tqdm.write(text, file=sys.stderr)


@contextmanager
def tell(text: str) -> Iterator[None]:
    """Says `text` if the block takes long."""
    timer = Timer(LONG, say, (f"{text} ...",))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def table_lines(columns: Mapping[str, str], rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """`rows` as a table in Markdown, of those of their keys that are `columns`.

    `columns` say how each is formatted; what is None, or not there, leaves an empty cell.
    """
    lines = [[key.replace("_", " ") for key in columns], ["---"] * len(columns)]
    for row in rows:
        values = [(row.get(key), form) for key, form in columns.items()]
        lines.append(["" if value is None else format(value, form) for value, form in values])
    return [f"| {' | '.join(cells)} |" for cells in lines]
