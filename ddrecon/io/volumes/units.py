"""Units as files spell them, and how much of ours they are."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping

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
