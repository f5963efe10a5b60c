"""Archives of numpy, and what every volume must be: what is not is refused with advice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refusal

from ddrecon.io.volumes.table import read_field

BOUNDS = np.array([[-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]])
CUBE = np.ones((2, 2, 2))


@pytest.mark.parametrize("dtype", [np.float16, np.float64, np.uint8, bool])
def test_every_real_type_is_read_as_float32(tmp_path: Path, dtype: type) -> None:
    np.savez(tmp_path / "f.npz", density=np.ones((2, 3, 4), dtype))
    field = read_field(tmp_path / "f.npz", "density")
    assert field.values.dtype == np.float32 and field.values.min() == 1 and field.bounds is None


def flawed(value: float) -> np.ndarray:
    values = np.zeros((2, 3, 4))
    values[1, 2, 3] = value
    return values


PLACE = "at cell (x, y, z) = (3, 2, 1) (1 such values)"
LEGAL_BOX = "bounds must be [[xmin"
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"lwc": CUBE, "reff": CUBE, "bounds": BOUNDS}, "has no field 'density'; it has 'lwc', 'reff'"),
    (
        {"arr_0": CUBE, "bounds": BOUNDS},
        "has no field 'density'; it has 'arr_0'; say name: arr_0 beside file",
    ),
    *(
        ({"density": np.ones(shape)}, "expected [z, y, x]")
        for shape in ((), (4,), (2, 2), (2, 2, 2, 2), (2, 2, 2, 3, 1), (0, 2, 2))
    ),
    ({"density": np.ones((1, 1, 1), complex)}, "complex"),
    ({"density": np.array([[["a"]]])}, "values of type"),
    ({"density": flawed(np.nan)}, f"density is NaN or infinite {PLACE}"),
    ({"density": flawed(1e300)}, f"density is NaN or infinite {PLACE}"),
    ({"density": flawed(-0.5)}, f"density is negative {PLACE}"),
    *(
        ({"density": CUBE, "bounds": bounds}, LEGAL_BOX)
        for bounds in (BOUNDS[::-1], BOUNDS[:1], np.full((2, 3), np.nan), BOUNDS.T)
    ),
]


@pytest.mark.parametrize(("arrays", "told"), REFUSED)
def test_what_is_no_field_is_refused_with_advice(
    tmp_path: Path, arrays: dict[str, Any], told: str
) -> None:
    np.savez(tmp_path / "f.npz", **arrays)
    assert told in refusal(tmp_path / "f.npz")


def test_unknown_suffixes_list_the_known(tmp_path: Path) -> None:
    assert ".npz" in refusal(tmp_path / "f.txt")
