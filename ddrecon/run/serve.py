"""A page on this machine's own address, for its own browsers only."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socket import create_server, socket
from threading import Lock

from ddrecon.errors import UsageError

HOST = "127.0.0.1"
PORT = 8765
"""Where a page is served if that is free, and nothing else is asked for."""


def listen(port: int | None) -> socket:
    """A socket that listens at `port` of localhost; None: at PORT, or a free one if it is taken.

    Browsers that ask before a page is served there wait for it. Raises UsageError where `port` is
    taken.
    """
    if port is None:
        try:
            return create_server((HOST, PORT))
        except OSError:
            port = 0
    try:
        return create_server((HOST, port))
    except OSError as error:
        reason = error.strerror or error
        raise UsageError(f"--port {port}: {reason}; leave it out for a free one") from error


def url_of(listening: socket) -> str:
    """What a browser is given to see what is served at the socket."""
    return f"http://{HOST}:{listening.getsockname()[1]}/"


@contextmanager
def serve_page(page: Callable[[], str], listening: socket) -> Iterator[ThreadingHTTPServer]:
    """A server of `page()`, made anew for each request, at the socket `listening`."""
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

    server = ThreadingHTTPServer(listening.getsockname(), Handler, bind_and_activate=False)
    server.socket.close()
    server.socket = listening
    with server:
        yield server
