"""Equations are stated once, on one of two pages, and cited by tag where the code computes them."""

import re
from itertools import groupby
from pathlib import Path

ROOT = Path(__file__).parents[2]
TAG = re.compile(r"\bE(\d+)\.(\d+)(?:-E?\1\.(\d+))?\b")
PAGES = {name: (ROOT / "docs" / name).read_text() for name in ("theory.md", "corrections.md")}
Tag = tuple[int, int]
"""Section and number."""


def tags(text: str) -> set[Tag]:
    """The tags in `text`; E2.4-E2.6 stands for E2.4, E2.5 and E2.6."""
    return {
        (int(section), number)
        for section, first, last in TAG.findall(text)
        for number in range(int(first), int(last or first) + 1)
    }


def stated_tags(text: str) -> list[Tag]:
    """The tags of the equations in `text`, from top to bottom."""
    return [
        tag for line in re.findall(r"^\*\*(E[\d.]+)\*\*", text, re.MULTILINE) for tag in tags(line)
    ]


STATED = sorted(tag for page in PAGES.values() for tag in stated_tags(page))
CITED = {
    path.relative_to(ROOT): tags(path.read_text())
    for suffix in ("*.py", "*.h")
    for path in sorted((ROOT / "ddrecon").rglob(suffix))
}


def test_tags_count_up_in_the_section_where_they_stand() -> None:
    for page in PAGES.values():
        sections = re.split(r"^## (\d+)\. ", page, flags=re.MULTILINE)[1:]
        for section, text in zip(sections[::2], sections[1::2], strict=True):
            tags_of_section = stated_tags(text)
            assert all(tag[0] == int(section) for tag in tags_of_section)
            assert tags_of_section == sorted(tags_of_section)
        assert len(stated_tags(page)) == len(stated_tags("".join(sections[1::2])))


def test_every_tag_stands_once_and_none_is_left_out() -> None:
    for section, group in groupby(STATED, key=lambda tag: tag[0]):
        numbers = [number for _, number in group]
        assert numbers == list(range(1, len(numbers) + 1)), section


def test_every_tag_in_the_code_is_stated() -> None:
    unstated = {str(path): cited - set(STATED) for path, cited in CITED.items()}
    assert {path: missing for path, missing in unstated.items() if missing} == {}


def test_every_equation_of_the_model_is_cited_in_the_code() -> None:
    assert set().union(*CITED.values()) == set(STATED)
