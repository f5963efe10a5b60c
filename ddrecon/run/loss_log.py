"""The loss log of a run: `loss.csv`, a row an iteration, whole whenever it is looked at."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from ddrecon.errors import DataWarning
from ddrecon.io.files.atomic import flush, refusals, replace_file
from ddrecon.reconstruct.log import Row

COLUMNS = [field.name for field in fields(Row)]


def _known(text: str) -> float | None:
    return float(text) if text else None


READERS: dict[str, Callable[[str], Any]] = {
    "iteration": int,
    "seconds": float,
    "loss": float,
    "data_loss": float,
    "penalty": float,
    "psnr": float,
    "test_psnr": _known,
    "forward_iterations": int,
    "adjoint_iterations": int,
    "cells": int,
    "ssim": _known,
    "test_ssim": _known,
    "chi_square": _known,
}
"""What reads the text of a cell, by column."""


class LossLog:
    """The log in the file at `path`.

    Whatever writes raises FormatError where the system refuses.
    """

    def __init__(self, path: Path):
        self.path = path

    def start(self) -> None:
        """Begins anew."""
        self._write([])

    def cut(self, iteration: int) -> None:
        """Removes the rows after `iteration`, where a resumed run goes on.

        Warns where some before it are missing.
        """
        rows = self._read()[:iteration]
        if len(rows) < iteration:
            warnings.warn(
                f"{self.path}: has {len(rows)} of the {iteration} iterations made", DataWarning, 2
            )
        self._write(rows)

    def add(self, row: Row) -> None:
        """Adds one row."""
        with refusals(self.path), self.path.open("a", newline="") as stream:
            csv.writer(stream).writerow(_cells(row))

    def flush(self) -> None:
        """Returns when all rows are on the disk."""
        flush(self.path)

    def rows(self) -> list[Row]:
        """What was written."""
        return [
            Row(*(READERS[name](cell) for name, cell in zip(COLUMNS, row, strict=True)))
            for row in self._read()
        ]

    def _write(self, rows: list[list[str]]) -> None:
        with replace_file(self.path) as temporary, temporary.open("w", newline="") as stream:
            csv.writer(stream).writerows([COLUMNS, *rows])

    def _read(self) -> list[list[str]]:
        """The rows up to the first that is not whole, or not the next iteration's."""
        try:
            with self.path.open(newline="", errors="replace") as stream:
                _, *rows = csv.reader(stream)
        except (OSError, ValueError, csv.Error):
            return []
        count = next(
            (i for i, row in enumerate(rows) if len(row) != len(COLUMNS) or row[0] != str(i + 1)),
            len(rows),
        )
        return rows[:count]


def _cells(row: Row) -> list[Any]:
    values = (getattr(row, name) for name in COLUMNS)
    return [
        "" if value is None else f"{value:.8g}" if isinstance(value, float) else value
        for value in values
    ]
