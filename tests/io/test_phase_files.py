"""Tables of phase functions: what is read, and one line for what cannot be."""

import numpy as np
import pytest

from ddrecon.errors import FormatError
from ddrecon.io.phase_files import read_phase_table
from ddrecon.numerics.series import STEPS, at_even_angles

DEGREES = np.array([0.0, 20.0, 90.0, 150.0, 180.0])
VALUES = np.array([[5.0, 3.0, 1.0, 0.5, 0.7], [6.0, 2.0, 1.0, 0.4, 0.6], [7.0, 1.0, 1.0, 0.3, 0.5]])


def write(path, header, columns, separator=", "):
    rows = [separator.join(repr(float(number)) for number in row) for row in columns.T]
    path.write_text("\n".join(["# of a test", header, *rows]) + "\n")
    return path


@pytest.mark.parametrize("colors", [1, 3])
def test_a_table_is_read_whatever_its_form(tmp_path, colors):
    table, header = np.vstack([DEGREES, VALUES[:colors]]), ", ".join("rgb"[:colors])
    cosines = np.vstack([np.cos(np.radians(DEGREES)), VALUES[:colors]])
    for path in (
        write(tmp_path / "a.csv", f"angle, {header}", table),
        write(tmp_path / "descending.csv", f"angle, {header}", table[:, ::-1]),
        write(tmp_path / "cosine.txt", f"cosine, {header}", cosines, "  "),
    ):
        angles, found = read_phase_table(path)
        np.testing.assert_allclose(angles, np.radians(DEGREES), atol=1e-7)
        np.testing.assert_allclose(found, VALUES[:colors])


WRONG = {
    "no header": ("0, 1\n180, 1\n", "call it angle"),
    "few angles": ("angle, p\n0, 1\n90, 1\n180, 1\n", "at least 4"),
    "half": ("angle, p\n0, 1\n30, 1\n60, 1\n90, 1\n", "from 0 to 90 degrees; it must go from 0 to"),
    "twice": ("angle, p\n0, 1\n90, 1\n90, 2\n180, 1\n", "90 degrees twice"),
    "degrees as cosines": ("cosine, p\n0, 1\n90, 1\n120, 2\n180, 1\n", "call them angle"),
    "negative": ("angle, p\n0, 1\n90, -1\n120, 2\n180, 1\n", "values below 0"),
    "dark": ("angle, p\n0, 0\n90, 0\n120, 0\n180, 0\n", "nothing above 0"),
    "two colors": ("angle, r, g\n0, 1, 1\n90, 1, 1\n120, 2, 1\n180, 1, 1\n", "2 columns of values"),
    "ragged": ("angle, p\n0, 1\n90\n120, 2\n180, 1\n", "line 3 has 1 numbers"),
    "words": ("angle, p\n0, 1\n90, much\n", "line 3 is not numbers"),
    "not finite": ("angle, p\n0, 1\n90, nan\n120, 2\n180, 1\n", "not finite"),
    "empty": ("", "no numbers"),
    "a sheet": ("PK", "no table of text"),
}


@pytest.mark.parametrize(("text", "line"), WRONG.values(), ids=WRONG.keys())
def test_what_is_wrong_with_a_table_is_one_line(tmp_path, text, line):
    path = tmp_path / ("table.xlsx" if text == "PK" else "table.csv")
    path.write_text(text)
    with pytest.raises(FormatError, match=line) as caught:
        read_phase_table(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_even_angles_keep_what_is_given_and_stay_between_neighbors():
    angles = np.linspace(0, np.pi, STEPS // 4 + 1)
    values = np.stack([np.exp(3 * np.cos(angles)), 1 + np.cos(angles) ** 2])
    found = at_even_angles(angles, values)
    np.testing.assert_allclose(found[:, ::4], values, rtol=1e-12)
    exact = np.linspace(0, np.pi, STEPS + 1)
    smooth = np.stack([np.exp(3 * np.cos(exact)), 1 + np.cos(exact) ** 2])
    np.testing.assert_allclose(found, smooth, rtol=1e-4)
    coarse = at_even_angles(np.radians(DEGREES), VALUES)
    assert coarse.min() >= VALUES.min() and coarse.max() <= VALUES.max()
