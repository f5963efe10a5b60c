"""One page of HTML that needs nothing beside it, for all that is reported: `assets/page.html`.

Which sections it has is said by the facts that it is given; text is escaped by the template. Curves
are lines and texts that the template draws as SVG: matplotlib is an extra and takes seconds to
start, and a report is written after every run.
"""

import base64
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ddrecon.io.files.atomic import write_bytes

Point = tuple[float, float]
INK, COLORS = "currentColor", ("#3b82c4", "#d1603d", "#3f9a5f")
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 520, 280, 62, 12, 26, 40
"""A plot and its margins, in units of SVG."""
LEGEND = 70
"""Room for a name in the legend."""
MOST_POINTS = 500
"""Points of a curve that are drawn."""


def write_page(path: Path, **facts: Any) -> None:
    """Writes the page of these `facts` to `path`."""
    write_bytes(path, page_text(**facts).encode(errors="replace"))


def page_text(**facts: Any) -> str:
    """The page: its `title`, `lead`, a sentence, and the sections whose facts are there.

    While a job `goes_on`, browsers load its page again and again. A page that `is_small` is laid
    out for a frame within another page. What the other facts hold the template says.
    """
    from jinja2 import Environment, PackageLoader  # here, so that commands start at once

    loader = PackageLoader("ddrecon.report", "assets")
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True)
    environment.filters["uri"] = embed
    return environment.get_template("page.html").render(facts)


def embed(image: bytes) -> str:
    """The address of the PNG or WebP `image`, which holds it."""
    kind = "png" if image.startswith(b"\x89PNG") else "webp"
    return f"data:image/{kind};base64,{base64.b64encode(image).decode('ascii')}"


class Plot(NamedTuple):
    """A picture under `title`, in units of SVG.

    `lines` are (x1, y1, x2, y2, class of the page's style), `curves` a color and points, `texts`
    (x, y, anchor, color, text).
    """

    title: str
    lines: list[tuple[float, float, float, float, str]]
    curves: list[tuple[str, list[Point]]]
    texts: list[tuple[float, float, str, str, str]]
    width: int = WIDTH
    height: int = HEIGHT


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
    end, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
    left, right, across_at = _axis([x for p in drawn.values() for x, _ in p], LEFT, end)
    low, high, up_at = _axis([y for p in drawn.values() for _, y in p], bottom, TOP)
    plot = Plot(title, [], [], [(LEFT, 16, "start", INK, title)])
    # A line across for every round value of y, a number below for every one of x.
    for value in (logarithmic_ticks if is_logarithmic else ticks)(low, high):
        y, label = up_at(value), f"{10**value if is_logarithmic else value:.4g}"
        plot.lines.append((LEFT, y, end, y, "grid"))
        plot.texts.append((LEFT - 6, y + 4, "end", INK, label))
    numbers = ((across_at(value), f"{value:.6g}") for value in ticks(left, right))
    plot.texts.extend((x, bottom + 17, "middle", INK, label) for x, label in numbers)
    plot.texts.append((end, HEIGHT - 6, "end", INK, across))
    plot.lines.extend((x, TOP, x, bottom, "step") for x in map(across_at, steps))
    plot.lines.append((LEFT, bottom, end, bottom, "axis"))
    # The curves, and their names in the legend.
    for index, (name, points) in enumerate(drawn.items()):
        color = COLORS[index % len(COLORS)]
        places = [(across_at(x), up_at(y)) for x, y in points]
        # A line of one point goes from there to there.
        plot.curves.append((color, places if places[1:] else 2 * places))
        plot.texts.append((end - LEGEND * (len(drawn) - 1 - index), 16, "end", color, name))
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
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [index * step for index in range(first, last + 1)]


def logarithmic_ticks(low: float, high: float) -> list[float]:
    """The decimal logarithms of round values in [10^`low`, 10^`high`], `low` < `high`.

    They are 1, 2, 5, 10, ..., or powers of ten.
    """
    decades = range(math.floor(low), math.ceil(high) + 1)
    factors = (1, 2, 5) if high - low < 2 else (1,)
    every = -(-len(decades) // 6)
    values = [decade + math.log10(factor) for decade in decades[::every] for factor in factors]
    return [value for value in values if low - 1e-9 <= value <= high + 1e-9] or ticks(low, high)
