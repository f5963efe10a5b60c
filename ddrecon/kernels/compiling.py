"""Kernels are compiled once, then come from Warp's cache; those of a computation side by side.

Which ones a computation needs is known once it has come to each. So it is rehearsed: launches tell
what they would launch and do nothing, and what kernels would make is zero.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from threading import Timer
from time import perf_counter
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ddrecon import engine

LOG = logging.getLogger(engine.LOG)
COMPILED = 0.5
"""A kernel that takes longer to load [s] is being compiled; others come from Warp's cache."""
PAUSE = 5.0
"""A line says how far that is, no more often than this [s]."""
_compiled: list[str] = []
"""The names of those that were."""
_loaded: set[tuple[Any, str]] = set()
"""Kernels that this process has, by their devices."""
_last_line = -PAUSE
"""When the last line was written."""
_rehearsed: dict[tuple[Any, str], None] | None = None
"""Kernels that a rehearsal came to, with their devices, in that order; None while there is none."""


def compile_rehearsed(computation: Callable[[], object]) -> None:
    """Has the kernels of `computation` made ready, where this process has loaded none yet.

    They are compiled in as many threads as torch has. `computation` is called in rehearsal, so it
    is to work on what nobody else reads.
    """
    if _loaded:
        return
    global _rehearsed
    kernels = _rehearsed = {}
    try:
        computation()
    except Exception as error:
        # It goes wrong again in earnest, and is told there; or it came of the zeros, and what the
        # rehearsal did not come to is compiled when it is needed.
        LOG.debug("the rehearsal ended early, by %s: %s", type(error).__name__, error)
    finally:
        _rehearsed = None
    pool = ThreadPoolExecutor(torch.get_num_threads(), "compiling")
    try:
        # Adjoints, which come last, take longest.
        list(pool.map(lambda one: load(one[0], one[1], len(kernels)), reversed(kernels)))
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def is_rehearsed(kernel: Any, device: str) -> bool:
    """Whether this is a rehearsal, which then knows of `kernel`."""
    if _rehearsed is not None:
        _rehearsed[kernel, device] = None
    return _rehearsed is not None


def clear_in_rehearsal(arrays: Iterable[Any]) -> None:
    """Makes those `arrays` zero that kernels would write, where this is a rehearsal."""
    if _rehearsed is not None:
        for array in arrays:
            if isinstance(array, Tensor):
                array.zero_()


def load(kernel: Any, device: str, count: int = 0) -> None:
    """Has `kernel` compiled where Warp's cache has it not, one of `count` where these are known."""
    if (kernel, device) in _loaded:
        return
    start = perf_counter()
    line = Timer(COMPILED, _tell, (kernel.key, count))
    line.daemon = True
    line.start()
    try:
        wp.load_module(kernel.module, device=device)
    finally:
        line.cancel()
    _loaded.add((kernel, device))
    if perf_counter() - start > COMPILED:
        _compiled.append(kernel.key)


def _tell(name: str, count: int) -> None:
    """Writes a line while the kernel `name` is compiled, unless there was one just now."""
    global _last_line
    if perf_counter() - _last_line < PAUSE:
        return
    is_first, _last_line = _last_line < 0, perf_counter()
    if is_first:
        where = f"they stay in {wp.config.kernel_cache_dir}"
        LOG.warning("compiling kernels, which takes a minute or two, once: %s", where)
    else:
        of = f" of at most {count}" if count else ""
        LOG.warning("compiling kernels: %d%s done, now %s", len(_compiled), of, name)
