"""Equations are stated once, in docs/theory.md, and cited by tag where the code computes them."""

import re
from itertools import groupby
from pathlib import Path

ROOT = Path(__file__).parents[2]
TAG = re.compile(r"\bE(\d+)\.(\d+)(?:-E?\1\.(\d+))?\b")
THEORY = (ROOT / "docs" / "theory.md").read_text()
Tag = tuple[int, int]
"""Section and number."""


def tags(text: str) -> set[Tag]:
    """The tags in `text`; E2.4-E2.6 stands for E2.4, E2.5 and E2.6."""
    return {
        (int(section), number)
        for section, first, last in TAG.findall(text)
        for number in range(int(first), int(last or first) + 1)
    }


STATED = [
    tag for line in re.findall(r"^\*\*(E[\d.]+)\*\*", THEORY, re.MULTILINE) for tag in tags(line)
]
CITED = {
    path.relative_to(ROOT): tags(path.read_text())
    for suffix in ("*.py", "*.h")
    for path in sorted((ROOT / "ddrecon").rglob(suffix))
}


def test_tags_count_up_in_the_section_where_they_stand() -> None:
    sections = re.split(r"^## (\d+)\. ", THEORY, flags=re.MULTILINE)[1:]
    standing = {
        tag: int(number)
        for number, text in zip(sections[::2], sections[1::2], strict=True)
        for line in re.findall(r"^\*\*(E[\d.]+)\*\*", text, re.MULTILINE)
        for tag in tags(line)
    }
    assert list(standing) == STATED and all(tag[0] == own for tag, own in standing.items())
    for section, group in groupby(STATED, key=lambda tag: tag[0]):
        numbers = [number for _, number in group]
        assert numbers == list(range(1, len(numbers) + 1)), section


def test_every_tag_in_the_code_is_stated() -> None:
    unstated = {
        str(path): found - set(STATED) for path, found in CITED.items() if found - set(STATED)
    }
    assert unstated == {}


def test_every_equation_of_the_model_is_cited_in_the_code() -> None:
    assert set().union(*CITED.values()) == set(STATED)
