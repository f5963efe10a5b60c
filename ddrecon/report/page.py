"""Pages of HTML from headings, tables and pictures.

Text is escaped here; parts made here are put together as they are.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

from ddrecon.io.files.atomic import replace_file

ASSETS = resources.files("ddrecon.report") / "assets"
SCRIPTS = ("volumes.js", "viewer.js", "slices.js", "compare.js", "film.js", "page.js")
"""Scripts of a live page, in the order in which one needs the other."""
REFRESH = '<meta http-equiv="refresh" content="30">'
"""Makes a browser reload a page."""
PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">\
<meta name="viewport" content="width=device-width, initial-scale=1">\
{refresh}<title>{title}</title><style>{style}</style></head>
<body{state}>
<h1>{title}</h1>
<p id="lead">{lead}</p>
{sections}
{scripts}</body></html>
"""


def write_page(
    path: Path,
    title: str,
    lead: str,
    sections: Sequence[str],
    *,
    is_alive: bool = False,
    goes_on: bool = False,
) -> None:
    """Writes the page of `sections` under `title`, and `lead`, a sentence, to `path`.

    While the job `goes_on` that it is about, browsers load it again and again.
    """
    text = page_text(title, lead, sections, is_alive=is_alive, refresh=REFRESH if goes_on else "")
    with replace_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="replace")


def page_text(
    title: str,
    lead: str,
    sections: Sequence[str],
    *,
    is_alive: bool = False,
    state: str = "",
    refresh: str = "",
) -> str:
    """The page; with `is_alive`, with scripts that turn its volumes and compare its pictures.

    `state` are attributes of its body: with `class="small"`, it is laid out for a frame within
    another page. `refresh` is nothing, or `REFRESH`.
    """
    style, *scripts = (
        (ASSETS / name).read_text(encoding="utf-8")
        for name in ("page.css", *(SCRIPTS if is_alive else ()))
    )
    return PAGE.format(
        state=f" {state}" if state else "",
        refresh=refresh,
        title=escape(title),
        style=style,
        lead=escape(lead),
        sections="\n".join(sections),
        scripts="".join(f"<script>{script}</script>\n" for script in scripts),
    )


def section(heading: str, *blocks: str) -> str:
    """The `blocks` under `heading`."""
    name = heading.lower().replace(" ", "-")
    start = f'<section id="{escape(name)}"><h2>{escape(heading)}</h2>\n'
    return start + "\n".join(blocks) + "</section>"


def paragraph(text: str) -> str:
    return f"<p>{escape(text)}</p>"


def items(lines: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def warnings(lines: Sequence[str]) -> str:
    """A list of `lines` that stands out."""
    return f'<div class="doubts">{items(lines)}</div>'


def side_by_side(*blocks: str) -> str:
    """The `blocks` two in a row where there is room, else below each other."""
    return f'<div class="row">{"".join(f"<div>{block}</div>" for block in blocks)}</div>'


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table of `rows` under `head`; it scrolls by itself where it is too wide."""
    above = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    lines = ["".join(f"<td>{escape(str(cell))}</td>" for cell in row) for row in rows]
    text = "".join(f"<tr>{line}</tr>" for line in (above, *lines))
    return f'<div class="scroll"><table>{text}</table></div>'


def versions(environment: Mapping[str, Any]) -> str:
    lists = ((k, v if isinstance(v, list) else [v]) for k, v in environment.items())
    return table(["", ""], [(name, " ".join(map(str, values))) for name, values in lists])


def picture(png: bytes, caption: str) -> str:
    """The picture `png`, whose pixels are shown as squares, above `caption`."""
    return captioned(embed(png, caption, 'class="pixels" style="width: 600px"'), caption)


def pair(target: bytes, render: bytes, caption: str) -> str:
    """Two pictures of one view side by side, or one over the other where scripts run."""
    images = embed(target, f"{caption}, target") + embed(render, f"{caption}, render")
    return captioned(f'<div class="pair">{images}</div>', caption)


def embed(image: bytes, text: str, attributes: str = "") -> str:
    """An element with the PNG or WebP `image` in it; `text` says what it shows."""
    kind = "png" if image.startswith(b"\x89PNG") else "webp"
    data = base64.b64encode(image).decode("ascii")
    return f'<img src="data:image/{kind};base64,{data}" alt="{escape(text)}" {attributes}>'


def grid(blocks: Sequence[str]) -> str:
    """The `blocks` in as many columns as there is room for."""
    return f'<div class="views">{"".join(blocks)}</div>'


def unfolded(summary: str, block: str, *, is_open: bool) -> str:
    """The `block` below `summary`, which folds it away."""
    start = "<details open>" if is_open else "<details>"
    return f"{start}<summary>{escape(summary)}</summary>{block}</details>"


def scrub(figures: Sequence[str]) -> str:
    """The `figures` below each other, or one at a time with a slider where scripts run."""
    return f'<div class="film">{"".join(figures)}</div>'


def captioned(element: str, caption: str) -> str:
    return f"<figure>{element}<figcaption>{escape(caption)}</figcaption></figure>"


def fold(summary: str, text: str) -> str:
    """`text` as it stands, shown when `summary` is clicked."""
    return unfolded(summary, f"<pre>{escape(text)}</pre>", is_open=False)
