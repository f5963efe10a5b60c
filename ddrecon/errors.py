"""The ways ddrecon refuses its input or gives up, each with the exit code of the command line.

Everything a user can cause is a `DdreconError`; whatever else is raised is a bug and keeps its
traceback.
"""

from __future__ import annotations

from collections.abc import Sequence

LONGEST = 1000
"""Lines of more characters are shortened in the middle."""


def one_line(text: str) -> str:
    """`text` as a line that can be printed: what cannot be is escaped, and what is too long
    shortened.
    """
    line = (
        text
        if text.isprintable()
        else "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    )
    return line if len(line) <= LONGEST else f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"


class DdreconError(Exception):
    """Base of every error a user can cause; `exit_code` is what the command line returns."""

    exit_code = 2


class _ProblemsError(DdreconError):
    """One line for each of `problems`."""

    def __init__(self, problems: str | Sequence[str]):
        each = [problems] if isinstance(problems, str) else problems
        self.problems = [one_line(problem) for problem in each]
        super().__init__("\n".join(self.problems))


class SceneError(_ProblemsError):
    """A scene that cannot be used; a problem reads `file:line:column: key.path: what is wrong`."""


class UsageError(_ProblemsError):
    """A command that cannot be carried out as it was given: an output that is there already, a
    locked folder, a device or a checkpoint that is missing.
    """


class FormatError(DdreconError):
    """A data file that exists but cannot be used, or several: the first, and the lines that tell of
    the `others`.
    """

    exit_code = 3

    def __init__(self, path: object, reason: str, others: Sequence[str] = ()):
        self.path, self.reason = str(path), reason
        self.lines = [one_line(line) for line in (f"{path}: {reason}", *others)]
        super().__init__("\n".join(self.lines))


class MissingExtraError(DdreconError):
    """An optional package that a command cannot do without, and that is not installed."""

    exit_code = 3


class SolveError(DdreconError):
    """A linear solve or an optimization that did not converge; the last good state is kept."""

    exit_code = 4

    def __init__(self, what: str, iterations: int, residual: float, advice: str):
        self.iterations, self.residual, self.advice = iterations, residual, advice
        super().__init__(
            f"{what} after {iterations} iterations (residual {residual:.2e}); {advice}"
        )


class DivergenceError(SolveError):
    """An optimization that cannot go on: `iteration`, counted from 1, failed by what `what` says;
    `residual` is that of its solve.
    """

    def __init__(self, iteration: int, what: str, residual: float, advice: str):
        self.what, self.iterations, self.residual, self.advice = what, iteration, residual, advice
        DdreconError.__init__(self, f"iteration {iteration}: {what}; {advice}")

    def with_advice(self, more: str) -> DivergenceError:
        """The same with `more` to know."""
        return DivergenceError(self.iterations, self.what, self.residual, f"{self.advice}; {more}")


class DataWarning(UserWarning):
    """Data that was used, but not as it stands."""
