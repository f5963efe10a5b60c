"""How work that takes long shows how far it is."""

import os
import pty
from contextlib import suppress

import pytest
from tqdm import tqdm

from ddrecon.progress import bar_settings


def test_a_terminal_without_a_size_gets_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """As containers and `script` open them: 0 columns, 0 rows."""
    reader, writer = pty.openpty()
    with os.fdopen(writer, "w") as terminal:
        monkeypatch.setattr("sys.stderr", terminal)
        for _ in tqdm(range(2), **bar_settings(is_quiet=False)):
            pass
    told = b""
    with suppress(OSError):  # which says that the terminal was closed
        while part := os.read(reader, 4096):
            told += part
    assert b"2/2" in told
    os.close(reader)
