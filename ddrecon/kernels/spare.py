"""Memory that is used again: a processor's fresh pages cost more than the numbers in them.

The system clears a page when it is first written to, a few hundred microseconds for each megabyte,
and what a large tensor gives up goes back to the system at once. A solve would spend half its time
on that. So what tensors give up is kept, where the C library can be told so.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
from typing import Any

LARGEST, MOST_FREE = 2**28, 2**30
"""Bytes of arrays that the system gives and takes each time; and so much free stays at most.

GNU's C library itself has at most 32 and 64 MiB.
"""
MOST_COPIED = 2**30
"""Bytes that copies of numbers take at most, one for each thread, if there are more than a few."""
GIVEN_BACK = 2**20
"""Bytes of arrays that the system gets back at once where memory is short."""
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""What GNU's mallopt calls the two."""
_OWN_CHOICES = "GLIBC_TUNABLES", "MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_"


def count_shares(threads: int, size: int, least: int = 2) -> int:
    """How many of `threads` add to numbers of `size` bytes: each adds to a copy of its own."""
    return min(threads, max(least, MOST_COPIED // max(1, size)))


@functools.cache
def keep_freed_memory() -> None:
    """Has the C library keep what tensors give up for those to come, unless the user chose."""
    _choose(LARGEST, MOST_FREE)


def give_freed_memory() -> None:
    """Has the C library give the system back what tensors give up, unless the user chose.

    Arrays of other sizes then find it: of a large volume the peak is about two thirds as high, and
    an iteration takes up to twice as long.
    """
    keep_freed_memory()  # which is not done again, and so undoes nothing
    _choose(GIVEN_BACK, GIVEN_BACK)


def trim_freed_memory() -> None:
    """Gives the system back what lies unused between tensors: once, for little time."""
    if (trim := _c_function("malloc_trim")) is not None:
        trim(0)


def _choose(largest: int, most_free: int) -> None:
    choose = _c_function("mallopt")
    if choose is not None and choose(_MMAP_THRESHOLD, largest):
        choose(_TRIM_THRESHOLD, most_free)


@functools.cache
def _c_function(name: str) -> Any:
    """The C library's function of this `name`; None where it has none, or the user chose."""
    if sys.platform != "linux" or any(one in os.environ for one in _OWN_CHOICES):
        return None
    # Other libraries than GNU's have no such choice, or decide for themselves.
    return getattr(ctypes.CDLL(None), name, None)
