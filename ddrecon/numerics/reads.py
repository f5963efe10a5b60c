"""Whether Python may read numbers of tensors: it may not in what a GPU is to replay as a graph."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

_may_read = True


def may_read() -> bool:
    """Whether a computation may depend on numbers that it reads."""
    return _may_read


@contextmanager
def without_reads() -> Iterator[None]:
    """Within it nothing is read: solves make as many iterations as they are told."""
    global _may_read
    _may_read = False
    try:
        yield
    finally:
        _may_read = True
