"""Equations are stated once, in docs/theory.md, and cited by tag where the code computes them."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
TAG = re.compile(r"\bE(\d+)(?:-E?(\d+))?\b")


def tags(text: str) -> set[int]:
    """Numbers of the tags in `text`; E4-E6 stands for E4, E5 and E6."""
    return {
        number
        for first, last in TAG.findall(text)
        for number in range(int(first), int(last or first) + 1)
    }


STATED = {
    int(number)
    for number in re.findall(
        r"^\W*E(\d+)\b", (ROOT / "docs" / "theory.md").read_text(), re.MULTILINE
    )
}
CITED = {
    path.relative_to(ROOT): tags(path.read_text())
    for path in sorted((ROOT / "ddrecon").rglob("*.py"))
}


ABOUT_DERIVATIVES = {10}
"""Stated for readers alone: what is differentiated, which no single line computes."""


def test_theory_states_the_equations_without_a_gap() -> None:
    assert set(range(1, max(STATED) + 1)) == STATED and len(STATED) >= 13


def test_every_tag_in_the_code_is_stated() -> None:
    unstated = {str(path): found - STATED for path, found in CITED.items() if found - STATED}
    assert unstated == {}


def test_every_equation_of_the_model_is_cited_in_the_code() -> None:
    assert set().union(*CITED.values()) | ABOUT_DERIVATIVES == STATED
