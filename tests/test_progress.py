"""A bar has room in 80 columns, and does not fill the log of a farm."""

import io
import os
import pty
import re
import sys
from contextlib import suppress

import pytest
from tqdm import tqdm

from ddrecon.progress import bar_settings
from ddrecon.run.job import drive


class FakeJob:
    """A job of so many iterations, which take no time."""

    title = "optimize"

    def __init__(self, count):
        self.total, self.iteration = count, 0

    @property
    def is_done(self):
        return self.iteration == self.total

    def step(self):
        """One more iteration, and what is said of it."""
        self.iteration += 1
        return "PSNR 41.3/31.2 dB"


@pytest.mark.parametrize("is_terminal", [True, False])
def test_a_bar_of_80_columns_and_a_log(monkeypatch, is_terminal):
    stderr = io.StringIO()
    stderr.isatty = lambda: is_terminal  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stderr", stderr)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("ddrecon.progress._is_quiet", False)
    drive(FakeJob(1000), None)  # type: ignore[arg-type]
    *states, last = stderr.getvalue().rstrip().split("\r")
    assert len(last) < 80 and last.endswith("PSNR 41.3/31.2 dB]")
    assert len(re.search(r"\|(.*)\|", last).group(1)) >= 10  # type: ignore[union-attr]
    assert is_terminal or len(states) <= 2


def test_a_terminal_without_a_size_gets_progress(monkeypatch):
    """As containers and `script` open them: 0 columns, 0 rows."""
    reader, writer = pty.openpty()
    with os.fdopen(writer, "w") as terminal:
        monkeypatch.setattr("sys.stderr", terminal)
        monkeypatch.setattr("ddrecon.progress._is_quiet", False)
        for _ in tqdm(range(2), **bar_settings()):
            pass
    told = b""
    with suppress(OSError):  # which says that the terminal was closed
        while part := os.read(reader, 4096):
            told += part
    assert b"2/2" in told
    os.close(reader)
