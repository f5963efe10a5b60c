"""Shares of a launch: each is done once, whichever thread does it."""

from collections.abc import Iterator
from threading import Event

import pytest
import torch

pytest.importorskip("warp")

from ddrecon.kernels import launch as launching

COUNT = 101
HERE = torch.zeros(1)


@pytest.fixture
def done(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """What launches did: first item, number of items, and the arguments."""
    seen: list[tuple[int, ...]] = []

    def note(kernel: object, device: object, size: int, given: list[int], stream: None) -> None:
        seen.append((given[0], size, *given[1:]))

    monkeypatch.setattr(launching, "_call", note)
    monkeypatch.setattr(launching, "load", lambda kernel, device: None)
    return seen


@pytest.fixture
def busy() -> Iterator[None]:
    """While it lasts, no thread but that of the test does anything."""
    free = Event()
    waiting = [launching._pool(2).submit(free.wait) for _ in range(2)]
    yield
    free.set()
    for one in waiting:
        one.result()


SHARES = [(0, 50, 0), (50, 51, 1)]


def test_shares_that_no_thread_begins_are_done_by_the_one_that_asks(done, busy):
    launching.launch(object(), COUNT, lambda i: [i], HERE, threads=2)
    assert sorted(done) == SHARES


def test_quick_launches_have_the_same_shares(done, monkeypatch):
    kernel = object()
    monkeypatch.setattr(launching, "thread_count", lambda like: 2)
    for seconds in (2 * launching.QUICK, launching.QUICK / 2):
        monkeypatch.setattr(launching, "_seconds", _Seconds(seconds))
        launching.launch(kernel, COUNT, lambda i: [i], HERE)
    assert sorted(done[:2]) == done[2:] == SHARES


@pytest.mark.parametrize(("threads", "shared"), [(2, 2), (None, 1), (1, 0)])
def test_a_quick_launch_is_shared_where_threads_are_given(done, monkeypatch, threads, shared):
    """By time goes only the second launch, which the first one told to be quick."""
    shares: list[int] = []
    share = launching._share
    monkeypatch.setattr(launching, "thread_count", lambda like: 2)
    monkeypatch.setattr(launching, "_seconds", {})
    monkeypatch.setattr(launching, "_share", lambda *given: shares.append(1) or 0 * share(*given))
    kernel = object()
    for _ in range(2):
        launching.launch(kernel, COUNT, lambda i: [i], HERE, threads)
    assert len(shares) == shared


class _Seconds(dict):
    """That every launch takes so many seconds."""

    def __init__(self, seconds: float):
        self.seconds = seconds

    def get(self, key: object, default: float = 0.0) -> float:
        return self.seconds
