"""Shares of a launch: each is done once, whichever thread does it."""

from threading import Event

import pytest
import torch

pytest.importorskip("warp")

from ddrecon.kernels import launch as launching

COUNT = 101
HERE = torch.zeros(1)


@pytest.fixture
def done(monkeypatch):
    """What launches did: first item, number of items, and the record."""
    calls: list[tuple[int, ...]] = []
    monkeypatch.setattr(launching, "_call", lambda *of: calls.append(of[2:5]))
    monkeypatch.setattr(launching, "load", lambda kernel, device: None)
    return calls


@pytest.fixture
def busy():
    """While it lasts, no thread but that of the test does anything."""
    free = Event()
    waiting = [launching._pool(2).submit(free.wait) for _ in range(2)]
    yield
    free.set()
    for one in waiting:
        one.result()


def test_shares_that_no_thread_begins_are_done_by_the_one_that_asks(done, busy):
    launching.launch(object(), COUNT, [0, 1], HERE, threads=2)
    assert sorted(done) == [(0, 50, 0), (50, 51, 1)]


@pytest.mark.parametrize(("threads", "shared"), [(2, 2), (None, 1), (1, 0)])
def test_a_quick_launch_is_shared_where_threads_are_given(done, monkeypatch, threads, shared):
    """By time goes only the second launch, which the first one told to be quick."""
    shares: list[int] = []
    share = launching._share
    monkeypatch.setattr(launching, "thread_count", lambda like: 2)
    monkeypatch.setattr(launching, "_seconds", {})
    monkeypatch.setattr(launching, "_share", lambda *of: shares.append(1) or 0 * share(*of))
    kernel = object()
    for _ in range(2):
        launching.launch(kernel, COUNT, [0], HERE, threads)
    assert len(shares) == shared
    assert sum(items for _, items, _ in done) == 2 * COUNT
