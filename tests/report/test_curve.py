"""Curves are drawn where their numbers are, between round ticks."""

from __future__ import annotations

import itertools
import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ddrecon.report.curve import MOST, draw_curve, logarithmic_ticks, ticks

FINITE = st.floats(-1e3, 1e3)


def places(svg: str) -> list[list[tuple[float, float]]]:
    """The points of every line."""
    lines = re.findall(r'<polyline points="([^"]*)"', svg)
    return [
        [(float(x), float(y)) for x, y in (pair.split(",") for pair in line.split())]
        for line in lines
    ]


@given(FINITE, st.floats(1e-2, 1e6))
def test_ticks_are_round_and_within(low: float, span: float) -> None:
    found = ticks(low, low + span)
    slack = 1e-6 * span + 1e-9 * abs(low)
    assert 2 <= len(found) <= 6
    assert all(low - slack <= value <= low + span + slack for value in found)
    steps = {round((b - a) / span, 6) for a, b in itertools.pairwise(found)}
    mantissa = 10 ** (math.log10(found[1] - found[0]) % 1)
    assert len(steps) == 1 and min(abs(mantissa - factor) for factor in (1, 2, 5, 10)) < 1e-3


@given(st.floats(-12, 12), st.floats(1e-3, 20))
def test_logarithmic_ticks_lie_within_and_ascend(low: float, span: float) -> None:
    found = logarithmic_ticks(low, low + span)
    assert 1 <= len(found) <= 8 and found == sorted(found)
    assert all(low - 1e-6 <= value <= low + span + 1e-6 for value in found)


def test_a_straight_line_stays_straight_and_a_power_becomes_one() -> None:
    linear = places(draw_curve("a", {"": [(float(x), 3 * x - 1.0) for x in range(9)]}, "x"))
    power = places(
        draw_curve("a", {"": [(float(x), 10.0**-x) for x in range(9)]}, "x", is_logarithmic=True)
    )
    for (line,), sign in ((linear, -1), (power, 1)):
        slopes = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in itertools.pairwise(line)]
        assert all(
            slope * sign > 0 and slope == pytest.approx(slopes[0], abs=0.01) for slope in slopes
        )


def test_what_cannot_be_drawn_is_left_out() -> None:
    (line,) = places(
        draw_curve(
            "a",
            {"": [(0.0, 1.0), (1.0, math.nan), (2.0, -1.0), (3.0, math.inf), (4.0, 2.0)]},
            "x",
            is_logarithmic=True,
        )
    )
    assert len(line) == 2
    assert "polyline" not in draw_curve("a", {"": [(0.0, math.nan)]}, "x")


def test_a_long_log_is_thinned_and_keeps_its_ends() -> None:
    points = [(float(x), float(x % 7)) for x in range(20_003)]
    (line,), ends = (
        places(draw_curve("a", {"": points}, "x")),
        places(draw_curve("a", {"": [points[0], (points[-1][0], 6.0)]}, "x"))[0],
    )
    assert len(line) <= MOST + 20
    assert (line[0][0], line[-1][0]) == (ends[0][0], ends[-1][0])
