"""A field on a grid as files hold it, the rules that every volume format shares, and units.

Values are `[z, y, x]` or `[z, y, x, 3]`, cell-centered; bounds are in world order (x, y, z).
"""

import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.reading import as_float32

BOX = "[[xmin, ymin, zmin], [xmax, ymax, zmax]]"
"""What `bounds` are, in messages."""
Fields = Mapping[str, np.ndarray]
"""Values of several fields of the same cells, by name."""
Facts = Mapping[str, str | np.ndarray]
"""What is the same everywhere, by name: texts, and arrays of one number or three."""
VECTORS = ("velocity",)
"""Names of fields whose three numbers are along x, y and z, not colors."""
EMPTY = 1e-4
"""Cells below this part of the largest value count as empty: an optimization leaves none at 0."""


@dataclass(frozen=True, eq=False)
class Field:
    """`values` float32 [z, y, x] or [z, y, x, 3], finite, in a box.

    `bounds` float64 [2, 3] are the corners (x, y, z) of the box [u], where the file says them, and
    so is how many `meters` a u has; `unit` is that of the values, as it spells it, "" where it
    could say one, and `labels` are what else it says of the field: texts, or lists of numbers.
    """

    values: np.ndarray
    bounds: np.ndarray | None = None
    unit: str | None = None
    meters: float | None = None
    labels: Mapping[str, Any] = field(default_factory=dict)

    @property
    def resolution(self) -> tuple[int, int, int]:
        """Cells along (x, y, z)."""
        z, y, x = self.values.shape[:3]
        return x, y, z


def prune(values: np.ndarray) -> np.ndarray:
    """`values` [z, y, x] or [z, y, x, 3] with 0 in cells of less than `EMPTY` of the largest."""
    sizes = np.abs(values).reshape(*values.shape[:3], -1).max(-1, keepdims=True)
    is_empty = sizes <= EMPTY * sizes.max()  # nowhere if any is NaN
    return np.where(is_empty.reshape(*values.shape[:3], *[1] * (values.ndim - 3)), 0, values)


def check_field(path: Path, name: str, values: np.ndarray, bounds: np.ndarray | None) -> Field:
    """The field of `values` and `bounds` in the file at `path`; raises FormatError unless legal.

    Axes of one entry behind or before those of cells and colors go.
    """
    while values.ndim > 3 and values.shape[-1] == 1:
        values = values[..., 0]
    while values.ndim > 3 + (values.shape[-1:] == (3,)) and len(values) == 1:
        values = values[0]
    if values.ndim not in (3, 4) or values.shape[3:] not in ((), (3,)) or values.size == 0:
        legal = "expected [z, y, x] or [z, y, x, 3], at least one cell"
        raise FormatError(path, f"{name} has shape {list(values.shape)}; {legal}")
    values = as_float32(values)
    is_legal = np.isfinite(values)
    if not is_legal.all():
        z, y, x = np.argwhere(~is_legal)[0, :3]
        count = np.count_nonzero(~is_legal)
        where = f"cell (x, y, z) = ({x}, {y}, {z}) ({count} such values)"
        raise FormatError(path, f"{name} is NaN or infinite at {where}; clean it first")
    if bounds is not None and not (
        bounds.shape == (2, 3) and np.isfinite(bounds).all() and (bounds[0] < bounds[1]).all()
    ):
        raise FormatError(path, f"bounds must be {BOX} with each minimum below its maximum")
    return Field(values, None if bounds is None else bounds.astype(np.float64))


PREFIXES = {"": 1.0, "k": 1e3, "kilo": 1e3, "c": 1e-2, "m": 1e-3, "u": 1e-6, "micro": 1e-6}


def _with_prefixes(*units: str) -> dict[str, float]:
    return {prefix + unit: size for prefix, size in PREFIXES.items() for unit in units}


METERS = _with_prefixes("m", "meter", "meters", "metre", "metres")
"""Meters in a unit of length, by its spelling."""
MICROMETERS = {unit: 1e6 * size for unit, size in METERS.items()} | {"micron": 1, "microns": 1}
GRAMS = _with_prefixes("gm-3", "g/m3")
"""Grams in a cubic meter, by the unit's spelling."""
KELVIN = dict.fromkeys(("k", "kelvin", "kelvins", "degk"), 1.0)


def size_of(unit: str, spellings: Mapping[str, float]) -> float | None:
    """The size of a `unit` that a file spells in its own way, where `spellings` have it."""
    plain = unicodedata.normalize("NFKC", unit).replace("μ", "u")
    plain = re.sub(r"\s*above.*|[\s^{}*._]", "", plain)  # m above sea level; g m^{-3}; g.m**-3
    return None if plain == "Mm" else spellings.get(plain.lower())  # megameters are no mm
