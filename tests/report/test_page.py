"""A page needs nothing beside it, and text in it is text."""

from __future__ import annotations

import base64
import re
from html.parser import HTMLParser
from pathlib import Path

from ddrecon.report.curve import draw_curve
from ddrecon.report.page import (
    fold,
    items,
    paragraph,
    picture,
    section,
    side_by_side,
    table,
    write_page,
)

NASTY = '<script>alert("&")</script>'
VOID = {"meta", "img"}


class Balance(HTMLParser):
    """Notes tags that are not closed in turn, and all text."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: object) -> None:
        """Those are closed."""

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def test_a_page_is_whole_and_escapes_what_it_is_told(tmp_path: Path) -> None:
    parts = [
        paragraph(NASTY),
        items([NASTY]),
        table([NASTY], [[NASTY]]),
        fold(NASTY, NASTY),
        picture(b"PNG", NASTY),
        draw_curve(NASTY, {NASTY: [(0.0, 1.0)]}, NASTY),
    ]
    write_page(tmp_path / "report.html", NASTY, NASTY, [section(NASTY, side_by_side(*parts))])
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    reader = Balance()
    reader.feed(text)
    assert reader.open == [] and "<script>" not in text
    assert sum(NASTY in piece for piece in reader.text) == 14


def test_a_page_names_no_other_file(tmp_path: Path) -> None:
    write_page(tmp_path / "report.html", "a", "b", [picture(b"\x89PNG...", "c")])
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    sources = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert [
        base64.b64decode(source.removeprefix("data:image/png;base64,")) for source in sources
    ] == [b"\x89PNG..."]
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
