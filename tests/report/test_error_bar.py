"""What a drawn error bar says, read off its lines."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest

from ddrecon.report.error_bar import WIDTH, draw_error_bar


@pytest.mark.parametrize(
    ("value", "deviation"), [(2.0, 0.5), (-3.0, 0.2), (0.1, 4.0), (0.0, 0.0), (1e-9, 1e-12)]
)
def test_lines_are_as_long_as_deviations_on_the_scale_that_zero_tells(
    value: float, deviation: float
) -> None:
    root = ElementTree.fromstring(draw_error_bar("g<0>", value, deviation))
    zero, thin, thick = (
        [float(line.attrib[end]) for end in ("x1", "x2")] for line in root.findall("line")
    )
    (circle,) = root.findall("circle")
    dot = float(circle.attrib["cx"])
    assert all(0 <= end <= WIDTH for end in (*zero, *thin, *thick))
    # Lengths, to how they are rounded, in units of the distance from the dot to zero.
    assert (thick[1] - thick[0]) * abs(value) == pytest.approx(
        2 * deviation * abs(dot - zero[0]), abs=0.2 * max(abs(value), deviation)
    )
    assert thin[1] - thin[0] == pytest.approx(2 * (thick[1] - thick[0]), abs=0.3)
    assert (dot - zero[0]) * value >= 0
