"""Kernels are compiled once, then come from Warp's cache.

Whoever launches a kernel names its adjoint as well, long before that is needed: it is compiled
meanwhile, by another thread.
"""

from __future__ import annotations

import functools
import logging
import os
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Timer
from time import perf_counter
from typing import Any

import torch
import warp as wp

from ddrecon import engine

LOG = logging.getLogger(engine.LOG)
COMPILED = 0.5
"""A kernel that takes longer to load [s] is being compiled; others come from Warp's cache."""
PAUSE = 5.0
"""A line says how far that is, no more often than this [s]."""
_loaded: set[tuple[Any, str]] = set()
"""Kernels that this process has, by their devices."""
_named: dict[tuple[Any, str], Future[None]] = {}
"""Those that other threads were asked for."""
_last_line = -PAUSE
"""When the last line was written."""


def name_kernel(kernel: Any, device: str) -> None:
    """Has another thread load a `kernel` that is needed later, where there may be several."""
    key, others = (kernel, device), torch.get_num_threads() - 1
    if others > 0 and key not in _loaded and key not in _named:
        _named[key] = _pool(others).submit(_load, kernel, device)


def load(kernel: Any, device: str) -> None:
    """Has `kernel` compiled where Warp's cache has it not; waits where that has begun."""
    if (kernel, device) in _loaded:
        return
    named = _named.get((kernel, device))
    if named is None or named.cancel():
        _load(kernel, device)
    else:
        named.result()


def _load(kernel: Any, device: str) -> None:
    line = Timer(COMPILED, _tell, (kernel.key,))
    line.daemon = True
    line.start()
    try:
        wp.load_module(kernel.module, device=device)
    finally:
        line.cancel()
    _loaded.add((kernel, device))


def _tell(name: str) -> None:
    """Writes a line while the kernel `name` is compiled, unless there was one just now."""
    global _last_line
    if perf_counter() - _last_line < PAUSE:
        return
    is_first, _last_line = _last_line < 0, perf_counter()
    if is_first:
        where = f"they stay in {wp.config.kernel_cache_dir}"
        LOG.warning("compiling kernels, which takes a minute or two, once: %s", where)
    else:
        more = max(1, len(_named.keys() - _loaded))  # that one, if no other is known
        LOG.warning(
            "compiling kernels: %d done, %d or more to do, now %s", len(_loaded), more, name
        )


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "compiling")


# Threads do not live on in a process forked from this one, and what they had begun never ends.
os.register_at_fork(after_in_child=_pool.cache_clear)
os.register_at_fork(after_in_child=_named.clear)
