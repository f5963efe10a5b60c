"""Kernels are compiled once, then come from Warp's cache; those of a computation side by side.

Which ones a computation needs is known once it has come to each. So it is rehearsed: launches tell
what they would launch and do nothing, and what kernels would make is zero.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from time import perf_counter
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ddrecon import engine

LOG = logging.getLogger(engine.LOG)
COMPILED = 0.5
"""A kernel that takes longer to load [s] was compiled; others come from Warp's cache."""
_compiled: list[float] = []
"""How long each took to load [s]; a line says so of the first."""
_rehearsed: dict[tuple[Any, str], None] | None = None
"""Kernels that a rehearsal came to, with their devices, in that order; None while there is none."""


def compile_rehearsed(computation: Callable[[], object]) -> None:
    """Has the kernels of `computation` made ready, where this process has loaded none yet.

    They are compiled in as many threads as torch has. `computation` is called in rehearsal, so it
    is to work on what nobody else reads.
    """
    if load.cache_info().currsize:
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
        list(pool.map(lambda each: load(*each), reversed(kernels)))
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


@functools.cache
def load(kernel: Any, device: str) -> None:
    """Has `kernel` compiled where Warp's cache has it not; a line says so of the first."""
    start = perf_counter()
    wp.load_module(kernel.module, device=device)
    if (seconds := perf_counter() - start) > COMPILED:
        if not _compiled:
            LOG.info("compiling kernels, once: %.1f s for the first of them", seconds)
        _compiled.append(seconds)
