"""Curves of a page, as lines and texts that its template draws as SVG.

matplotlib is an extra and takes seconds to start; a report is written after every run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

Point = tuple[float, float]
INK = "currentColor"
COLORS = ("#3b82c4", "#d1603d", "#3f9a5f")
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 520, 280, 62, 12, 26, 40
"""The picture and the margins of its plot, in units of SVG."""
LEGEND = 70
"""Room for a name in the legend."""
MOST_POINTS = 500
"""Points of a curve that are drawn."""


@dataclass
class Plot:
    """A picture under `title`, in units of SVG.

    `lines` are (x1, y1, x2, y2, class), `curves` a color and points, `texts` (x, y, anchor, color,
    text).
    """

    title: str
    width: int = WIDTH
    height: int = HEIGHT
    lines: list[tuple[float, float, float, float, str]] = field(default_factory=list)
    curves: list[tuple[str, list[Point]]] = field(default_factory=list)
    texts: list[tuple[float, float, str, str, str]] = field(default_factory=list)

    def write(
        self, x: float, y: float, text: str, anchor: str, color: str = "currentColor"
    ) -> None:
        """Adds a text."""
        self.texts.append((round(x, 1), round(y, 1), anchor, color, text))

    def draw(self, x1: float, y1: float, x2: float, y2: float, kind: str) -> None:
        """Adds a line of this `kind`, a class of the page's style."""
        self.lines.append((round(x1, 1), round(y1, 1), round(x2, 1), round(y2, 1), kind))


def draw_curve(
    title: str,
    series: Mapping[str, Sequence[Point]],
    across: str,
    is_logarithmic: bool = False,
    steps: Sequence[float] = (),
) -> Plot:
    """The `series` of points (x, y) as lines with a legend; `across` says what x is.

    Lines from top to bottom mark what changes at the `steps` of x. With `is_logarithmic`, y > 0 is
    drawn by its logarithm. Points that are not finite are left out.
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
    left, right, across_at = _axis([x for p in drawn.values() for x, _ in p], LEFT, WIDTH - RIGHT)
    low, high, up_at = _axis([y for p in drawn.values() for _, y in p], HEIGHT - BOTTOM, TOP)
    plot = Plot(title)
    plot.write(LEFT, 16, title, "start")
    # A line across for every round value of y, a number below for every one of x.
    for value in (logarithmic_ticks if is_logarithmic else ticks)(low, high):
        y, label = up_at(value), f"{10**value if is_logarithmic else value:.4g}"
        plot.draw(LEFT, y, WIDTH - RIGHT, y, "grid")
        plot.write(LEFT - 6, y + 4, label, "end")
    for value in ticks(left, right):
        plot.write(across_at(value), HEIGHT - BOTTOM + 17, f"{value:.6g}", "middle")
    for x in map(across_at, steps):
        plot.draw(x, TOP, x, HEIGHT - BOTTOM, "step")
    plot.draw(LEFT, HEIGHT - BOTTOM, WIDTH - RIGHT, HEIGHT - BOTTOM, "axis")
    plot.write(WIDTH - RIGHT, HEIGHT - 6, across, "end")
    # The curves, and their names in the legend.
    for index, (name, points) in enumerate(drawn.items()):
        color = COLORS[index % len(COLORS)]
        places = [(round(across_at(x), 1), round(up_at(y), 1)) for x, y in points]
        # A line of one point goes from there to there.
        plot.curves.append((color, places if places[1:] else 2 * places))
        end = WIDTH - RIGHT - LEGEND * (len(drawn) - 1 - index)
        plot.write(end, 16, name, "end", color)
    return plot


def _axis(
    values: Sequence[float], first: float, last: float
) -> tuple[float, float, Callable[[float], float]]:
    """The least and the greatest of `values`, and where on an axis from `first` to `last` each is.

    A range of one value is widened, so that it has a middle and ticks; that of none is 0.
    """
    low, high = min(values, default=0.0), max(values, default=0.0)
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
