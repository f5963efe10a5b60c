"""Markdown is written one sentence a line, and its links lead somewhere."""

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
    """Paragraphs, headings and list items of a page, a list of lines each; no code or tables."""
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


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_a_page_has_one_short_sentence_a_line_and_names_what_exists(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    paragraphs = list(split_into_blocks(text))
    lines = [line for paragraph in paragraphs for line in paragraph]
    broken = (line for lines in paragraphs for line in lines[:-1] if not CLOSED.search(line))
    assert [line for line in lines if ends_early(line)] == [] == list(broken)
    assert [line for line in lines if len(strip_markup(line).split()) > LONGEST] == []
    assert [file for file in FILE.findall(text) if not (ROOT / file).exists()] == []
    for target in LINK.findall(re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)):
        path, _, anchor = target.partition("#")
        if "://" not in target and not target.startswith("mailto:"):
            there = (page.parent / path).resolve() if path else page
            assert there.exists(), f"{target}: there is no {there}"
            assert not anchor or anchor in find_anchors(there), f"{target}: no such heading"


def test_every_page_is_in_the_menu() -> None:
    listed = re.findall(r": (\w+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert sorted(listed) == sorted(page.name for page in (ROOT / "docs").glob("*.md"))
