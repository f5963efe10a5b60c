"""The page of a run while it goes on: what it shows, when it is done, and who may see it."""

import http.client
import os
import pty
import re
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from click.testing import Result
from tqdm import tqdm

from ddrecon.errors import UsageError
from ddrecon.progress import bar_settings
from ddrecon.run.live import LiveRun, serve_page

Run = Callable[..., Result]


@pytest.fixture
def stopped(succeed: Run) -> Path:
    """A run that has stopped halfway: its report is not there."""
    succeed("optimize", "scene.yaml", "-o", "out", "-q", "--iterations", "2")
    Path("out/report.html").unlink()
    return Path("out")


def test_a_run_is_shown_before_its_end(succeed: Run, stopped: Path) -> None:
    """With its loss, volume and views; then, when it is done, as its report."""
    live = LiveRun(stopped)
    page = live.page()
    assert "<body data-live>" in page and "iteration 2 of 2 after" in page
    for section in ("volume", "loss", "views"):
        assert f'<section id="{section}">' in page
    assert re.findall(r'class="field">{"name": "(\w+)", "of": "result"', page) == ["density"]
    assert page.count('<div class="pair">') == 2
    succeed("optimize", "scene.yaml", "-o", "out", "-q", "--resume", "--iterations", "3")
    assert live.page() == Path("out/report.html").read_text() and "data-live>" not in live.page()


def test_only_this_machine_sees_it() -> None:
    """Not under another's name for this address, and nothing but the page."""
    with serve_page(lambda: "<p>hello</p>", 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        port = server.server_address[1]
        assert server.server_address[0] == "127.0.0.1"
        answers = {}
        for host, path in (
            (f"127.0.0.1:{port}", "/"),
            (f"localhost:{port}", "/"),
            (f"elsewhere.example:{port}", "/"),
            (f"127.0.0.1:{port}", "/etc/passwd"),
        ):
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
            connection.request("GET", path, headers={"Host": host})
            answer = connection.getresponse()
            answers[host.partition(":")[0] + path] = (answer.status, answer.read())
        server.shutdown()
    assert answers["127.0.0.1/"] == answers["localhost/"] == (200, b"<p>hello</p>")
    assert answers["elsewhere.example/"][0] == answers["127.0.0.1/etc/passwd"][0] == 404


def test_a_port_that_is_taken() -> None:
    """Another is found where none was asked for; one that was is refused."""
    with serve_page(str, None) as first, serve_page(str, None) as second:
        port = first.server_port
        assert second.server_port != port
        with pytest.raises(UsageError, match=f"--port {port}: .* leave it out"):
            serve_page(str, port)


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
