"""Markdown is written one sentence a line, and its links lead somewhere."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [
    path
    for pattern in ("*.md", "docs/**/*.md", "benchmarks/**/*.md", "data/**/*.md")
    for path in sorted(ROOT.glob(pattern))
]
LATER = {ROOT / "CONTRIBUTING.md"}
"""Pages whose sentences are not held to a line each yet; their links are."""
ABBREVIATIONS = ("e.g", "i.e", "et al", "Fig", "Figs", "Eq", "Eqs", "cf", "vs", "resp", "approx")
"""What a full stop may follow within a sentence."""
LONGEST = 40
"""No sentence has more words."""

CODE_SPAN = re.compile(r"`[^`]*`")
LINK = re.compile(r"\]\(([^()\s]+)\)")
MARKER = re.compile(r"\s*(?:[-*+]|\d+\.)\s+|#+\s+(?:\d+\.\s+)?|>\s*")
LABEL = re.compile(r"\*\*[^*]+[.:?]\*\*\s+")
"""What a paragraph may begin with: its subject in bold."""
END = re.compile(r"(?<!\.)[.!?][)\]\"'*_]*\s+\S")
FILE = re.compile(r"`(?:python )?((?:ddrecon|tests|benchmarks|docs|configs|data|\.ci)/[\w./-]*)")
CLOSED = re.compile(r"[.:!?][)\]\"'*_]*$")


def split_into_blocks(text: str) -> Iterator[list[str]]:
    """Paragraphs, headings and list items of a page, a list of lines each.

    Code, tables, comments and pictures are left out.
    """
    paragraph: list[str] = []
    is_code = False
    for line in [*text.splitlines(), ""]:
        is_fence = line.lstrip().startswith("```")
        is_other = (
            is_code
            or is_fence
            or not line.strip()
            or line.startswith(("    ", "|", "<", "![", "#"))
        )
        if paragraph and (is_other or MARKER.match(line)):
            yield paragraph
            paragraph = []
        if line.startswith("#") and not is_code:
            yield [line]
        elif not is_other:
            paragraph.append(line)
        is_code ^= is_fence


def strip_markup(line: str) -> str:
    """`line` without its marker of a list or a heading, its label, code and targets of links."""
    for start in (MARKER, LABEL):
        match = start.match(line)
        line = line[match.end() :] if match else line
    return LINK.sub("]", CODE_SPAN.sub("code", line.strip()))


def ends_early(line: str) -> bool:
    """Whether a sentence ends before the end of `line`."""
    text = strip_markup(line)
    return any(not text[: match.start()].endswith(ABBREVIATIONS) for match in END.finditer(text))


def find_anchors(page: Path) -> set[str]:
    """What a link to a heading of `page` may hold after the #, on GitHub and the built site."""
    headings = [
        lines[0]
        for lines in split_into_blocks(page.read_text(encoding="utf-8"))
        if lines[0].startswith("#")
    ]
    words = [re.sub(r"[^\w\s-]", "", heading.lstrip("# ")).lower() for heading in headings]
    hosted, built = [
        {word.replace(" ", "-") for word in words},
        {re.sub(r"[-\s]+", "-", word.strip()) for word in words},
    ]
    return hosted & built


def named(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("One. Two.", True),
        ("- One (of two.) Two.", True),
        ("Is it? It is.", True),
        ("**Label.** Then more.", False),
        ("- **Label.** Then more. And more.", True),
        ("It is 0.5 in `a. b` of scene.yaml, e.g. Fig. 7 of Cen et al. 2023.", False),
        ("1. A step.", False),
        ("And so on ... to the end.", False),
    ],
)
def test_the_end_of_a_sentence_is_known(line: str, expected: bool) -> None:
    assert ends_early(line) == expected


@pytest.mark.parametrize("page", [page for page in PAGES if page not in LATER], ids=named)
def test_a_line_holds_one_sentence(page: Path) -> None:
    paragraphs = list(split_into_blocks(page.read_text(encoding="utf-8")))
    assert [line for lines in paragraphs for line in lines if ends_early(line)] == []
    assert [line for lines in paragraphs for line in lines[:-1] if not CLOSED.search(line)] == [], (
        "broken sentences"
    )


@pytest.mark.parametrize("page", [page for page in PAGES if page not in LATER], ids=named)
def test_sentences_are_not_too_long(page: Path) -> None:
    lines = [
        line for lines in split_into_blocks(page.read_text(encoding="utf-8")) for line in lines
    ]
    assert [line for line in lines if len(strip_markup(line).split()) > LONGEST] == []


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(
        r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL
    )
    for target in LINK.findall(text):
        if "://" in target or target.startswith("mailto:"):
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), f"{target}: there is no {there}"
        assert not anchor or anchor in find_anchors(there), (
            f"{target}: no such heading; there are {sorted(find_anchors(there))}"
        )


@pytest.mark.parametrize("page", [page for page in PAGES if page not in LATER], ids=named)
def test_files_that_a_page_names_exist(page: Path) -> None:
    files = FILE.findall(page.read_text(encoding="utf-8"))
    assert [file for file in files if not (ROOT / file).exists()] == []


def test_every_page_is_in_the_menu() -> None:
    listed = re.findall(r": (\w+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert sorted(listed) == sorted(page.name for page in (ROOT / "docs").glob("*.md"))
