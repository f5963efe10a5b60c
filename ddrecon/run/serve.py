"""A page on this machine's own address, for its own browsers only."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Lock

from ddrecon.errors import UsageError

HOST = "127.0.0.1"


@contextmanager
def serve_page(page: Callable[[], str], port: int) -> Iterator[ThreadingHTTPServer]:
    """A server of `page()`, made anew for each request, at `port` of localhost (0: a free one).

    Raises UsageError where the port is taken.
    """
    lock = Lock()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            # A site elsewhere may give its own name this address, to read what is here.
            name = self.headers.get("Host", "").rpartition(":")[0] or self.headers.get("Host", "")
            if self.path != "/" or name not in (HOST, "localhost"):
                self.send_error(404)
                return
            with lock:
                content = page().encode("utf-8")
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            """Requests are not told."""

    try:
        server = ThreadingHTTPServer((HOST, port), Handler)
    except OSError as error:
        raise UsageError(f"--port {port}: {error.strerror or error}; choose another") from error
    with server:
        yield server
