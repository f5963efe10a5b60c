"""Kernels are compiled once, then come from Warp's cache.

Whoever launches a kernel names its adjoint as well: another thread compiles it meanwhile.
"""

import functools
import logging
import os
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from threading import Timer
from typing import Any

import torch
import warp as wp

from ddrecon import engine

LOG = logging.getLogger(engine.LOG)
COMPILED = 0.5
"""A kernel that takes longer to load [s] is being compiled; others come from Warp's cache."""
_loaded: set[tuple[Any, str]] = set()
"""Kernels that this process has, by their devices."""
_named: dict[tuple[Any, str], Future[None]] = {}
"""Kernels that other threads were asked for."""
_waiting: list[tuple[Any, str]] = []
"""Those of them that none has begun. The last is needed first: the way back is the other way."""


def name_kernel(kernel: Any, device: str) -> None:
    """Has another thread load a `kernel` that is needed later, where there may be several."""
    key, threads = (kernel, device), torch.get_num_threads() - 1
    if threads > 0 and key not in _loaded and key not in _named:
        _named[key] = Future()
        _waiting.append(key)
        _pool(threads).submit(_load_last)


def load(kernel: Any, device: str) -> None:
    """Has `kernel` compiled where Warp's cache has it not.

    Where that has begun, it compiles meanwhile what else is waiting.
    """
    key = kernel, device
    if key in _loaded:
        return
    with suppress(ValueError):  # of one that is not waiting
        _waiting.remove(key)
        del _named[key]
    if key in _named:
        while _waiting and not _named[key].done():
            _load_last()
        _named[key].result()
    else:
        _load(kernel, device)


def _load_last() -> None:
    with suppress(IndexError):  # of none: others were quicker
        key = _waiting.pop()
        try:
            _load(*key)
            _named[key].set_result(None)
        except Exception as error:
            _named[key].set_exception(error)


def _load(kernel: Any, device: str) -> None:
    line = Timer(COMPILED, _announce)
    line.daemon = True
    line.start()
    try:
        wp.load_module(kernel.module, device=device)
    finally:
        line.cancel()
    _loaded.add((kernel, device))


@functools.cache
def _announce() -> None:
    where = wp.config.kernel_cache_dir
    LOG.warning("compiling kernels, which takes up to a minute, once: they stay in %s", where)


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "compiling")


# Threads do not live on in a process forked from this one, and what they had begun never ends.
os.register_at_fork(after_in_child=_pool.cache_clear)
os.register_at_fork(after_in_child=_named.clear)
os.register_at_fork(after_in_child=_waiting.clear)
