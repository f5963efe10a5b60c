"""A number and how far it may be off, as a small drawing."""

from __future__ import annotations

from html import escape

from ddrecon.report.curve import COLORS
from ddrecon.report.page import Drawing

WIDTH, HEIGHT = 100, 16


def draw_error_bar(name: str, value: float, deviation: float) -> Drawing:
    """A dot at `value`, a thick line one `deviation` to either side of it and a thin one two.

    The left end is 0 for a value above 0, the right end for one below: a short line is a number
    that is well known. Where two deviations reach beyond 0, they are all of the width.
    """
    reach = max(abs(value), 2 * deviation) or 1.0
    middle, one = WIDTH / 2, deviation / reach * (WIDTH / 2 - 4)
    lines = "".join(
        f'<line x1="{middle - n * one:.1f}" x2="{middle + n * one:.1f}" y1="8" y2="8"'
        f' stroke="{COLORS[0]}" stroke-width="{width}"/>'
        for n, width in ((2, 1.5), (1, 5))
    )
    zero = middle - value / reach * (WIDTH / 2 - 4)
    label = escape(f"{name}: {value:.5g}, deviation {deviation:.2g}")
    return Drawing(
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" style="width: {WIDTH}px" role="img"'
        f' aria-label="{label}">'
        f'<line x1="{zero:.1f}" x2="{zero:.1f}" y1="2" y2="14" stroke="currentColor"'
        ' opacity="0.5"/>'
        f'{lines}<circle cx="{middle:g}" cy="8" r="3" fill="currentColor"/></svg>'
    )
