"""Collecting what is wrong with a scene, so that a user is told all of it at once."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator
from contextlib import contextmanager

from ddrecon.errors import SceneError


class Problems:
    """The problem lines found so far."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def note(self, error: SceneError) -> None:
        """Notes the problems of `error`."""
        self.lines.extend(error.problems)

    @contextmanager
    def collecting(self) -> Iterator[None]:
        """Notes the problems of a SceneError raised inside the block, which ends there, and goes on after it."""
        try:
            yield
        except SceneError as error:
            self.note(error)

    def raise_any(self) -> None:
        """Raises SceneError with every problem noted, each once, if there is one."""
        if self.lines:
            raise SceneError(list(dict.fromkeys(self.lines)))


def suggestion(name: str, known: Collection[str]) -> str:
    """`; did you mean 'x'?` with the nearest of the `known` names, or the list of them where none is near."""
    near = difflib.get_close_matches(name.lower(), known, n=1)
    return f"; did you mean {near[0]!r}?" if near else f"; known: {', '.join(known)}"
