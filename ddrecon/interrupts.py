"""Ctrl-C: the program ends with one line and the exit code 130, at every moment.

A module that is being imported must not be interrupted by an exception: extensions in C crash of
one. There the process ends at once, as it does where the first Ctrl-C has not ended it yet; files
are replaced whole, so that none is torn.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

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
    if _is_importing(frame):
        end_at_once(number, frame)
    handle_interrupts(end_at_once)
    raise KeyboardInterrupt(what)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def handle_interrupts(handler: Any) -> Any:
    """Has `handler` called at Ctrl-C, unless that is ignored, as in the background; the old one."""
    old = signal.getsignal(signal.SIGINT)
    return old if old is signal.SIG_IGN else signal.signal(signal.SIGINT, handler)


@contextmanager
def interruptible() -> Iterator[None]:
    """Ctrl-C raises KeyboardInterrupt in the block."""
    old = handle_interrupts(interrupt)
    try:
        yield
    finally:
        handle_interrupts(old)


@contextmanager
def defer_interrupt() -> Iterator[list[int]]:
    """A list that fills when the process is asked to stop, so that no iteration is torn.

    Asked twice, it stops at once.
    """
    asked: list[int] = []

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
