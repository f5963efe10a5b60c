"""The loss log of a run: `loss.csv`, a row an iteration, whole whenever it is looked at."""

from __future__ import annotations

import csv
import warnings
from dataclasses import fields
from pathlib import Path
from typing import Any

from ddrecon.errors import DataWarning
from ddrecon.io.files.atomic import refusals, replace_file
from ddrecon.reconstruct.frame import Row

COLUMNS = [field.name for field in fields(Row)]


class LossLog:
    """The log in the file at `path`; what writes raises FormatError where the system refuses."""

    def __init__(self, path: Path):
        self.path = path

    def cut(self, iteration: int) -> None:
        """Removes the rows after `iteration`, where a resumed run goes on, and what is no row."""
        rows = [_cells(row) for row in self.rows() if row.iteration <= iteration]
        with replace_file(self.path) as temporary, temporary.open("w", newline="") as stream:
            csv.writer(stream).writerows([COLUMNS, *rows])

    def add(self, row: Row) -> None:
        """Adds one row."""
        with refusals(self.path), self.path.open("a", newline="") as stream:
            csv.writer(stream).writerow(_cells(row))

    def rows(self, count: int | None = None) -> list[Row]:
        """The readable rows, up to iteration `count` if given; warns if some are missing."""
        try:
            _, *lines = self.path.read_text(errors="replace").splitlines() or [""]
        except OSError:
            lines = []
        rows = [row for row in map(_row, lines) if row is not None]
        if count is None:
            return rows
        rows = [row for row in rows if row.iteration <= count]
        if len(rows) < count:
            warnings.warn(
                f"{self.path}: has {len(rows)} of the {count} iterations made", DataWarning, 2
            )
        return rows


def _row(line: str) -> Row | None:
    """What `line` says; None where it is not whole, or no number stands where one should."""
    read: dict[Any, Any] = {"int": int, "float": float}
    read["float | None"] = lambda cell: float(cell) if cell else None
    try:
        cells = zip(fields(Row), line.split(","), strict=True)
        return Row(*(read[column.type](cell) for column, cell in cells))
    except ValueError:
        return None


def _cells(row: Row) -> list[Any]:
    values = (getattr(row, name) for name in COLUMNS)
    return [f"{value:.8g}" if isinstance(value, float) else value for value in values]
