"""A deadline that a loaded machine does not shorten: seconds of this process's own time."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

LONGEST = 2.0


class Overdue(BaseException):
    """Not an Exception, so that nobody catches it."""


@contextmanager
def deadline(seconds: float = LONGEST) -> Iterator[None]:
    """Raises Overdue where the block takes more than `seconds` of the processor, if at its end."""

    def stop(_number: int, _frame: FrameType | None) -> None:
        raise Overdue(f"more than {seconds} s")

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
