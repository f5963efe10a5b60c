"""Curves as SVG within a page.

matplotlib is an extra and takes seconds to start; a report is written after every run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from html import escape

Point = tuple[float, float]
COLORS = ("#3b82c4", "#d1603d", "#3f9a5f")
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 520, 280, 62, 12, 26, 40
"""The picture and the margins of its plot, in units of SVG."""
LEGEND = 70
"""Room for a name in the legend."""
ROW = 20
"""Height of a row of bars."""
MOST_POINTS = 500
"""Points of a curve that are drawn."""


def draw_curve(
    title: str,
    series: Mapping[str, Sequence[Point]],
    across: str,
    is_logarithmic: bool = False,
    steps: Sequence[float] = (),
) -> str:
    """The `series` of points (x, y) as lines of an SVG with a legend; `across` says what x is.

    Lines from top to bottom mark what changes at the `steps` of x.
    With `is_logarithmic`, y > 0 is drawn by its logarithm. There must be at least one point; those
    that are not finite are left out.
    """
    # What is drawn: thinned, and by its logarithm where asked for.
    drawn = dict[str, list[Point]]()
    for name, points in series.items():
        finite = [(x, y) for x, y in points if math.isfinite(y)]
        if is_logarithmic:
            finite = [(x, math.log10(y)) for x, y in finite if y > 0]
        if finite:
            stride = max(1, len(finite) // MOST_POINTS)
            drawn[name] = [*finite[: len(finite) - 1 : stride], finite[-1]]
    xs = [x for points in drawn.values() for x, _ in points] or [0.0]
    ys = [y for points in drawn.values() for _, y in points] or [0.0]
    left, right, across_at = _axis(xs, LEFT, WIDTH - RIGHT)
    low, high, up_at = _axis(ys, HEIGHT - BOTTOM, TOP)
    elements = [_text(LEFT, 16, title, "start")]
    # A line across for every round value of y, a number below for every one of x.
    for value in (logarithmic_ticks if is_logarithmic else ticks)(low, high):
        y, label = up_at(value), f"{10**value if is_logarithmic else value:.4g}"
        elements.append(_line(y, 0.2))
        elements.append(_text(LEFT - 6, y + 4, label, "end"))
    for value in ticks(left, right):
        elements.append(_text(across_at(value), HEIGHT - BOTTOM + 17, f"{value:.6g}", "middle"))
    for x in map(across_at, steps):
        ends = f'x1="{x:.1f}" y1="{TOP}" x2="{x:.1f}" y2="{HEIGHT - BOTTOM}"'
        elements.append(f'<line {ends} stroke="currentColor" stroke-dasharray="4 4"/>')
    elements.append(_line(HEIGHT - BOTTOM, 0.7))
    elements.append(_text(WIDTH - RIGHT, HEIGHT - 6, across, "end"))
    # The curves, and their names in the legend.
    for index, (name, points) in enumerate(drawn.items()):
        color = COLORS[index % len(COLORS)]
        places = [(across_at(x), up_at(y)) for x, y in points]
        # A line of one point goes from there to there.
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in (places if places[1:] else 2 * places))
        style = f'fill="none" stroke="{color}" stroke-width="1.8" stroke-linecap="round"'
        elements.append(f'<polyline points="{line}" {style}/>')
        end = WIDTH - RIGHT - LEGEND * (len(drawn) - 1 - index)
        elements.append(_text(end, 16, name, "end", color=color))
    label = f'role="img" aria-label="{escape(title)}"'
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" {label}>{"".join(elements)}</svg>'


def draw_bars(rows: Sequence[tuple[str, float, float]]) -> str:
    """An SVG of the `rows` of a name, a value and its deviation: a bar of one and a line of two.

    All have one axis, so that values can be compared.
    """
    ends = [value + times * deviation for _, value, deviation in rows for times in (-2, 2)]
    low, high, at = _axis(ends, WIDTH / 2, WIDTH - RIGHT)
    bottom, elements = ROW * len(rows), list[str]()
    for index, (name, value, deviation) in enumerate(rows):
        y = ROW * (index + 0.5)
        elements.append(_text(WIDTH / 2 - 10, y + 4, name, "end"))
        for times, width in ((2, 1.2), (1, 6)):
            x1, x2 = at(value - times * deviation), at(value + times * deviation)
            place = f'x1="{x1:.1f}" y1="{y}" x2="{x2:.1f}" y2="{y}"'
            elements.append(f'<line {place} stroke="{COLORS[0]}" stroke-width="{width}"/>')
        elements.append(f'<circle cx="{at(value):.1f}" cy="{y}" r="3.5" fill="{COLORS[1]}"/>')
    for tick in ticks(low, high):
        elements.append(_text(at(tick), bottom + 14, f"{tick:.6g}", "middle"))
    label = f'role="img" aria-label="{escape(", ".join(name for name, _, _ in rows))}"'
    return f'<svg viewBox="0 0 {WIDTH} {bottom + 20}" {label}>{"".join(elements)}</svg>'


def _axis(
    values: Sequence[float], first: float, last: float
) -> tuple[float, float, Callable[[float], float]]:
    """The least and the greatest of `values`, and where on an axis from `first` to `last` each is.

    A range of one value is widened, so that it has a middle and ticks.
    """
    low, high = min(values), max(values)
    more = max(0.0, 1e-9 * max(abs(low), abs(high), 1e-3) - (high - low) / 2)
    low, high = low - more, high + more
    return low, high, lambda value: first + (value - low) / (high - low) * (last - first)


def ticks(low: float, high: float) -> list[float]:
    """About five round values in [`low`, `high`], `low` < `high`."""
    step = 10.0 ** math.floor(math.log10((high - low) / 4))
    step *= next((factor for factor in (1, 2, 5) if (high - low) / (step * factor) <= 5), 10)
    return [
        index * step
        for index in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    ]


def logarithmic_ticks(low: float, high: float) -> list[float]:
    """The decimal logarithms of round values in [10^`low`, 10^`high`], `low` < `high`.

    They are 1, 2, 5, 10, ..., or powers of ten.
    """
    decades = range(math.floor(low), math.ceil(high) + 1)
    factors = (1, 2, 5) if high - low < 2 else (1,)
    every = -(-len(decades) // 6)
    values = [decade + math.log10(factor) for decade in decades[::every] for factor in factors]
    inside = [value for value in values if low - 1e-9 <= value <= high + 1e-9]
    return inside or ticks(low, high)


def _line(y: float, opacity: float) -> str:
    """A line across the plot."""
    ends = f'x1="{LEFT}" y1="{y:.1f}" x2="{WIDTH - RIGHT}" y2="{y:.1f}"'
    return f'<line {ends} stroke="currentColor" stroke-opacity="{opacity}"/>'


def _text(x: float, y: float, text: str, anchor: str, color: str = "currentColor") -> str:
    style = f'font-size="12.5" text-anchor="{anchor}" fill="{color}"'
    return f'<text x="{x:.1f}" y="{y:.1f}" {style}>{escape(text)}</text>'
