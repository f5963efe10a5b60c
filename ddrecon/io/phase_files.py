"""Phase functions from files: values over the angle.

Text files (.csv, .txt) have numbers in columns, separated by commas or spaces, under a header that
names the columns; `#` begins a comment.
"""

from pathlib import Path

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.reading import guard_reading

SUFFIXES = (".csv", ".txt")
MAX_BYTES = 1 << 26
ENDS = 1e-3
"""How far [rad] a table may begin from 0 and end from pi."""


def read_phase_table(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Angles [n] [rad], increasing from 0 to pi, and values [C, n] >= 0 of the table at `path`.

    The first column are scattering angles in degrees, or their cosines. C is 1, or 3 where there is
    a column a color. Raises FormatError.
    """
    with guard_reading(path):
        name, (first, *columns) = _read_columns(path)
    values = np.array(columns)
    if name not in ("angle", "cosine"):
        raise FormatError(path, f"its first column is {name!r}; call it angle (degrees) or cosine")
    if len(first) < 4:
        raise FormatError(path, f"has {len(first)} angles; a table needs at least 4")
    if len(columns) not in (1, 3):
        raise FormatError(
            path, f"has {len(columns)} columns of values; expected 1, or 3 for r, g, b"
        )
    if not (np.isfinite(first).all() and np.isfinite(values).all()):
        raise FormatError(path, "holds numbers that are not finite")
    if name == "cosine" and np.abs(first).max() > 1 + 1e-6:
        raise FormatError(path, "has cosines beyond -1 and 1; are they degrees? call them angle")
    angles = np.arccos(first.clip(-1, 1)) if name == "cosine" else np.radians(first)
    order = np.argsort(angles)
    angles, values = angles[order], values[:, order]
    if (twice := np.flatnonzero(np.diff(angles) <= 0)).size:
        raise FormatError(path, f"has the angle {np.degrees(angles[twice[0]]):g} degrees twice")
    if angles[0] < 0 or angles[0] > ENDS or abs(angles[-1] - np.pi) > ENDS:
        low, high = np.degrees(angles[[0, -1]])
        raise FormatError(path, f"goes from {low:g} to {high:g} degrees; it must go from 0 to 180")
    if values.min() < 0 or (values.max(1) <= 0).any():
        raise FormatError(path, "has values below 0, or nothing above 0")
    angles[0], angles[-1] = 0, np.pi
    return angles, values


def _read_columns(path: Path) -> tuple[str, np.ndarray]:
    """The name of the first column, and columns of numbers below a line of names, if any."""
    if path.suffix.lower() not in SUFFIXES or path.stat().st_size > MAX_BYTES:
        raise FormatError(path, f"is no table of text ({', '.join(SUFFIXES)})")
    name, rows = "", list[list[float]]()
    for number, line in enumerate(path.read_text(encoding="utf-8-sig").splitlines(), 1):
        entries = line.split("#")[0].replace(",", " ").replace(";", " ").split()
        try:
            row = [float(entry) for entry in entries]
        except ValueError:
            if rows or name:
                raise FormatError(path, f"line {number} is not numbers: {line[:40]!r}") from None
            name, row = entries[0].strip("\"'").lower(), []
        rows += [row] if row else []
        if row and len(row) != len(rows[0]):
            counts = f"{len(row)} numbers, those before {len(rows[0])}"
            raise FormatError(path, f"line {number} has {counts}")
    if not rows:
        raise FormatError(path, "holds no numbers")
    return name, np.array(rows).T
