"""Pages of HTML from headings, tables and pictures.

Text is escaped here; parts made here are put together as they are.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from ddrecon.io.files.atomic import replace_file

STYLE = """
:root { color-scheme: light dark; --line: #8885; --soft: #8882; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 1080px; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; margin-bottom: 0; }
h2 { font-size: 1.15rem; margin: 2rem 0 0.5rem; border-bottom: 1px solid var(--line); }
figure { margin: 0.75rem 0; } figcaption { font-size: 0.9rem; opacity: 0.8; }
img { max-width: 100%; height: auto; image-rendering: pixelated; }
.row { display: grid; gap: 1rem; }
@media (min-width: 800px) { .row { grid-template-columns: 1fr 1fr; } }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
td, th { padding: 0.2rem 0.7rem 0.2rem 0; text-align: left; white-space: nowrap;
  border-bottom: 1px solid var(--soft); }
pre { overflow-x: auto; background: var(--soft); padding: 0.75rem; font-size: 0.8rem; }
svg { width: 100%; height: auto; }
"""
PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">\
<meta name="viewport" content="width=device-width, initial-scale=1">\
<title>{title}</title><style>{style}</style></head>
<body>
<h1>{title}</h1>
<p>{lead}</p>
{sections}
</body></html>
"""


def write_page(path: Path, title: str, lead: str, sections: Sequence[str]) -> None:
    """Writes the page of `sections` under `title`, and `lead`, a sentence, to `path`."""
    text = PAGE.format(
        title=escape(title), style=STYLE, lead=escape(lead), sections="\n".join(sections)
    )
    with replace_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def section(heading: str, *parts: str) -> str:
    """The `parts` under `heading`."""
    return f"<section><h2>{escape(heading)}</h2>\n" + "\n".join(parts) + "</section>"


def paragraph(text: str) -> str:
    """A paragraph."""
    return f"<p>{escape(text)}</p>"


def items(lines: Sequence[str]) -> str:
    """A list of `lines`."""
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def side_by_side(*parts: str) -> str:
    """The `parts` two in a row where there is room, else below each other."""
    return f'<div class="row">{"".join(f"<div>{part}</div>" for part in parts)}</div>'


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table of `rows` under `head`; it scrolls by itself where it is too wide."""
    above = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    lines = ["".join(f"<td>{escape(str(cell))}</td>" for cell in row) for row in rows]
    text = "".join(f"<tr>{line}</tr>" for line in (above, *lines))
    return f'<div class="scroll"><table>{text}</table></div>'


def picture(png: bytes, caption: str, width: int = 600) -> str:
    """The picture `png`, `width` pixels wide where there is room, above `caption`."""
    data = base64.b64encode(png).decode("ascii")
    shown = f'alt="{escape(caption)}" style="width: {width}px"'
    image = f'<img src="data:image/png;base64,{data}" {shown}>'
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"


def fold(summary: str, text: str) -> str:
    """`text` as it stands, shown when `summary` is clicked."""
    return f"<details><summary>{escape(summary)}</summary><pre>{escape(text)}</pre></details>"
