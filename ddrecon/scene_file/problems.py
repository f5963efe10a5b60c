"""Collecting what is wrong with a scene, so that a user sees all of it at once."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator
from contextlib import contextmanager

from ddrecon.errors import FormatError, SceneError

MOST = 30
"""Problems that are named in one go."""
LONGEST = 60
"""Names of more characters are not compared with those that are known."""


class Problems:
    """The problem lines found so far, and the files that could not be used."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.unusable: list[FormatError] = []

    @property
    def are_many(self) -> bool:
        """Whether there are more than are named: no need to look for others."""
        return len(self.lines) > MOST

    def note(self, error: SceneError | FormatError) -> None:
        """Notes the problems of `error`."""
        if isinstance(error, FormatError):
            self.unusable.append(error)
        else:
            self.lines.extend(error.problems)

    @contextmanager
    def collecting(self) -> Iterator[None]:
        """Notes the problems of an error raised inside the block, which ends there."""
        try:
            yield
        except (SceneError, FormatError) as error:
            self.note(error)

    def raise_any(self) -> None:
        """Raises an error with every problem noted, each once, if there is one.

        It is a FormatError where only files are to blame, else a SceneError.
        """
        files = dict.fromkeys(line for error in self.unusable for line in error.lines)
        lines = [*dict.fromkeys(self.lines), *files]
        if len(lines) > MOST:
            lines[MOST:] = ["and more: mend these first"]
        if self.lines:
            raise SceneError(lines)
        if self.unusable:
            first = self.unusable[0]
            raise FormatError(first.path, first.reason, lines[1:])


def suggestion(name: str, known: Collection[str]) -> str:
    """`; did you mean 'x'?` with the nearest of the `known` names, or the list of them."""
    near = difflib.get_close_matches(name.lower(), known, n=1) if len(name) <= LONGEST else []
    return f"; did you mean {near[0]!r}?" if near else f"; known: {', '.join(known)}"
