"""Ctrl-C: the program ends with one line and the exit code 130, at every moment.

An exception in the import of an extension in C crashes it: there the process ends at once, as it
does where the first Ctrl-C has not ended it yet. Files are replaced whole, so that none is torn.
"""

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


def interrupt(number: int, frame: FrameType | None, text: str = "") -> None:
    """Raises KeyboardInterrupt with `text`, as a handler of signals; ends the process at once where
    the signal is the second, or a module is imported.
    """
    caller = frame
    while caller is not None:
        if caller.f_code.co_filename.startswith("<frozen importlib"):
            end_at_once(number, frame)
        caller = caller.f_back
    signal.signal(signal.SIGINT, end_at_once)
    raise KeyboardInterrupt(text)


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

    Asked twice, it stops at once. Other threads than the main one are never asked.
    """
    asked: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        if asked:
            interrupt(number, frame, "at once; go on from the last checkpoint with --resume")
        asked.append(number)

    is_main = threading.current_thread() is threading.main_thread()
    numbers = (signal.SIGINT, signal.SIGTERM) if is_main else ()
    before = {number: signal.signal(number, note) for number in numbers}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
