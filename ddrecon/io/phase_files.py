"""Phase functions from files: values over the angle.

Text files (.csv, .txt) have numbers in columns, separated by commas or spaces, under a header that
names the columns; `#` begins a comment. Archives (.npz) have arrays of these names.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.reading import guard_reading
from ddrecon.io.volumes.npz import read_arrays

SUFFIXES = (".csv", ".txt", ".npz")
MAX_BYTES = 1 << 26
ABSCISSAS = ("angle", "cosine")
"""The first column: scattering angles in degrees, or their cosines."""
ENDS = 1e-3
"""How far [rad] a table may begin from 0 and end from pi."""


def read_phase_table(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Angles [n] [rad], increasing from 0 to pi, and values [C, n] >= 0 of the table at `path`.

    C is 1, or 3 where there is a column a color. Raises FormatError.
    """
    with guard_reading(path):
        names, columns = _read_columns(path)
    name = names[0] if names else ""
    if name not in ABSCISSAS:
        raise FormatError(path, f"its first column is {name!r}; call it angle (degrees) or cosine")
    if columns.shape[1] < 4:
        raise FormatError(path, f"has {columns.shape[1]} angles; a table needs at least 4")
    _require_colors(path, len(columns) - 1)
    if name == "cosine" and np.abs(columns[0]).max() > 1 + 1e-6:
        raise FormatError(path, "has cosines beyond -1 and 1; are they degrees? call them angle")
    angles = np.arccos(columns[0].clip(-1, 1)) if name == "cosine" else np.radians(columns[0])
    order = np.argsort(angles)
    angles, values = angles[order], columns[1:, order]
    if (np.diff(angles) <= 0).any():
        row = int(np.argmax(np.diff(angles) <= 0))
        raise FormatError(path, f"has the angle {np.degrees(angles[row]):g} degrees twice")
    if angles[0] < 0 or abs(angles[0]) > ENDS or abs(angles[-1] - np.pi) > ENDS:
        low, high = np.degrees(angles[[0, -1]])
        raise FormatError(path, f"goes from {low:g} to {high:g} degrees; it must go from 0 to 180")
    if values.min() < 0 or (values.max(1) <= 0).any():
        raise FormatError(path, "has values below 0, or nothing above 0")
    angles[0], angles[-1] = 0, np.pi
    return angles, values


def _require_colors(path: Path, count: int) -> None:
    if count not in (1, 3):
        raise FormatError(path, f"has {count} columns of values; expected 1, or 3 for r, g, b")


def _read_columns(path: Path) -> tuple[list[str], np.ndarray]:
    """Names of columns, none without a header, and the columns [k, n] of finite numbers."""
    if path.suffix.lower() not in SUFFIXES:
        raise FormatError(path, f"is no table; expected {', '.join(SUFFIXES)}")
    if path.suffix.lower() == ".npz":
        names, columns = _read_archive(path)
    else:
        names, columns = _read_text(path)
    if not np.isfinite(columns).all():
        raise FormatError(path, "holds numbers that are not finite")
    return names, columns


def _read_archive(path: Path) -> tuple[list[str], np.ndarray]:
    """Arrays called angle or cosine, then `value` [n] or [n, 3]."""
    arrays = read_arrays(path)
    first = [name for name in ABSCISSAS if name in arrays]
    if "value" not in arrays or arrays["value"].ndim not in (1, 2):
        raise FormatError(path, "has no array 'value' [n] or [n, 3]")
    values = np.atleast_2d(arrays["value"].T).astype(np.float64)
    columns = [np.atleast_1d(arrays[name]).astype(np.float64) for name in first[:1]]
    if any(column.shape != values.shape[1:] for column in columns):
        raise FormatError(path, f"{first[0]} and value have different lengths")
    return [*first[:1], *(["value"] * len(values))], np.concatenate(
        [*(c[None] for c in columns), values]
    )


def _read_text(path: Path) -> tuple[list[str], np.ndarray]:
    if path.stat().st_size > MAX_BYTES:
        raise FormatError(path, f"is larger than {MAX_BYTES >> 20} MiB; it is no table")
    names: list[str] = []
    rows: list[list[float]] = []
    for number, line in enumerate(path.read_text(encoding="utf-8-sig").splitlines(), 1):
        entries = line.split("#")[0].replace(",", " ").replace(";", " ").split()
        if not entries:
            continue
        try:
            rows.append([float(entry) for entry in entries])
        except ValueError:
            if rows or names:
                raise FormatError(
                    path, f"line {number} is not numbers: {line.strip()[:40]!r}"
                ) from None
            names = [entry.strip("\"'").lower() for entry in entries]
        if rows and len(rows[-1]) != len(names or rows[0]):
            raise FormatError(
                path,
                f"line {number} has {len(rows[-1])} numbers, but there are"
                f" {len(names or rows[0])} columns",
            )
    if not rows:
        raise FormatError(path, "holds no numbers")
    return names, np.array(rows).T
