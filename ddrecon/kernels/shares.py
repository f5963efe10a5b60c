"""Threads that add to the same numbers add to copies of them, as many as memory has room for."""

from __future__ import annotations

MOST_BYTES = 2**30
"""So much copies take at most, if there are more than the least."""


def count_shares(threads: int, size: int, least: int = 2) -> int:
    """How many copies there are, each of `size` bytes, and so how many of `threads` work."""
    return min(threads, max(least, MOST_BYTES // max(1, size)))
