"""Ctrl-C: the program ends with one line and the exit code 130, at every moment.

A module that is being imported must not be interrupted by an exception: extensions in C crash of
one. There the process ends at once, as it does where the first Ctrl-C has not ended it yet; files
are replaced whole, so that none is torn.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

INTERRUPTED = 130
"""The exit code of a program that was interrupted."""


def end_at_once(number: int, frame: FrameType | None) -> None:
    """Ends the process, as a handler of signals."""
    with suppress(OSError):
        os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)


def interrupt(number: int, frame: FrameType | None, what: str = "") -> None:
    """Raises KeyboardInterrupt that says `what`, as a handler of signals, the first time.

    A second signal, or one while a module is imported, ends the process at once.
    """
    caller = frame
    while caller is not None:
        if caller.f_code.co_filename.startswith("<frozen importlib"):
            end_at_once(number, frame)
        caller = caller.f_back
    signal.signal(signal.SIGINT, end_at_once)
    raise KeyboardInterrupt(what)


@contextmanager
def on_interrupt(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Ctrl-C calls `handler` in the block, unless it is ignored, as in the background."""
    old = signal.getsignal(signal.SIGINT)
    if old is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, old)


@contextmanager
def defer_interrupt() -> Iterator[list[int]]:
    """A list that fills when the process is asked to stop, so that no iteration is torn.

    Asked twice, it stops at once. Another thread than the main one is never asked.
    """
    asked: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return

    def note(number: int, frame: FrameType | None) -> None:
        if asked:
            interrupt(number, frame, "at once; go on from the last checkpoint with --resume")
        asked.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
