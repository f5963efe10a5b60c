"""Errors that a user can cause, each with the exit code of the command line.

All are a `DdreconError`; whatever else is raised is a bug and keeps its traceback.
"""

import difflib
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")

LONGEST = 1000
"""Lines of more characters are shortened in the middle."""
MOST = 30
"""Problems that are named in one go."""
LONGEST_NAME = 60
"""Names of more characters are not compared with those that are known."""


def one_line(text: str) -> str:
    """`text` as one printable line, without its middle beyond `LONGEST` characters."""
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return line if len(line) <= LONGEST else f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"


def is_utf8(name: object) -> bool:
    """Whether `name` is text, which the name of a file need not be: Python keeps its bytes so."""
    return not any("\ud800" <= character <= "\udfff" for character in str(name))


class DdreconError(Exception):
    """Base of every error a user can cause; `exit_code` is what the command line returns."""

    exit_code = 2


class _ProblemsError(DdreconError):
    """An error with one line for each of its `problems`."""

    def __init__(self, problems: str | Sequence[str]):
        lines = [problems] if isinstance(problems, str) else problems
        self.problems = [one_line(line) for line in lines]
        super().__init__("\n".join(self.problems))


class SceneError(_ProblemsError):
    """What the scene says cannot be used; the user mends the scene file, or a `-D` that changed it.

    A problem reads `file:line:column: key.path: what is wrong`, or `-D key.path=value: ...`.
    """


class UsageError(_ProblemsError):
    """What the command asks for cannot be done; the user changes the command, not the scene."""


class FormatError(DdreconError):
    """A data file, `path`, that exists but cannot be used; `more` are lines of further files."""

    exit_code = 3

    def __init__(self, path: object, reason: str, more: Sequence[str] = ()):
        self.path, self.reason = str(path), reason
        self.lines = [one_line(line) for line in (f"{path}: {reason}", *more)]
        super().__init__("\n".join(self.lines))


class MissingExtraError(FormatError):
    """An optional package that is not installed; `path` is the file, or the purpose, it is for."""


class SolveError(DdreconError):
    """A linear solve or an optimization that did not converge: `reason` after `iterations` with the
    relative `residual`; `advice` says what may help.
    """

    exit_code = 4

    def __init__(self, reason: str, iterations: int, residual: float, advice: str):
        self.iterations, self.residual, self.advice = iterations, residual, advice
        super().__init__(
            f"{reason} after {iterations} iterations (residual {residual:.2e}); {advice}"
        )


class DivergenceError(SolveError):
    """An optimization that cannot go on; the last good state is kept.

    `iteration`, counted from 1, failed for a `reason`; `residual` is that of its solve.
    """

    def __init__(self, iteration: int, reason: str, residual: float, advice: str):
        self.iterations, self.residual, self.advice = iteration, residual, advice
        DdreconError.__init__(self, f"iteration {iteration}: {reason}; {advice}")


class RanksError(DdreconError):
    """Processes that share a run and lost, or never found, one another."""

    exit_code = 5


class DataWarning(UserWarning):
    """Data that was used, but not as it stands."""


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


def gather(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """What `function` makes of each of `items`; raises the problems of all of them together."""
    problems, results = Problems(), list[R]()
    for item in items:
        with problems.collecting():
            results.append(function(item))
        if problems.are_many:
            break
    problems.raise_any()
    return results


def suggestion(name: str, known: Collection[str]) -> str:
    """`; did you mean 'x'?` with the nearest of the `known` names, or the list of them."""
    return nearest(name, known) or f"; known: {', '.join(known)}"


def nearest(name: str, known: Collection[str]) -> str:
    """`; did you mean 'x'?` with the nearest of the `known` names, empty where none is near."""
    near = difflib.get_close_matches(name.lower(), known, n=1) if len(name) <= LONGEST_NAME else []
    return f"; did you mean {near[0]!r}?" if near else ""
