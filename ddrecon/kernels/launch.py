"""Launching fused kernels on torch's tensors: in as many threads as torch has, or on a GPU.

Every kernel takes `first: int` before all else, and thread `wp.tid()` of a launch does item
`first + wp.tid()`: so the items of a launch can be shared among threads of a processor.
"""

import functools
import math
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from time import perf_counter
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ddrecon.errors import UsageError
from ddrecon.kernels.compiling import load, name_kernel

wp.config.log_level = wp.LOG_ERROR  # one line of ours says what is compiled
MOST = 2**31
"""Items of a launch are fewer."""
MOST_COPIED = 2**30
"""Bytes that copies of numbers take at most, one for each thread, if there are more than a few."""
QUICK = 1.5e-4
"""Handing a share to another thread takes about 50 microseconds; a launch, 20."""
_seconds: dict[tuple[Any, int], float] = {}
"""What a launch of a kernel took last in one thread [s], by the digits of its number of items.

Numbers of rays differ from view to view: the table stays small.
"""


def too_many(name: str, count: int) -> UsageError:
    """The error for so many items, or numbers, that kernels do not count so far."""
    return UsageError(
        f"{name}: {count} is too many for fused kernels, which count to 2^31; "
        "take fewer cells or pixels, or --engine torch"
    )


def count_shares(threads: int, size: int, least: int = 2) -> int:
    """How many of `threads` add to numbers of `size` bytes: each adds to a copy of its own."""
    return min(threads, max(least, MOST_COPIED // max(1, size)))


def thread_count(like: Tensor) -> int:
    """In how many threads kernels on tensors `like` this run: on a GPU one."""
    return 1 if like.is_cuda else torch.get_num_threads()


def launch(
    kernel: Any, count: int, records: Sequence[Any], like: Tensor, threads: int | None = None
) -> None:
    """Runs `kernel` for `count` items where tensor `like` lies.

    On a processor the items are cut into so many shares as there are `threads` (None: as many as
    torch has), which have a record each, or all the same one. Which thread does a share is left to
    chance, and changes no result: the one that asks does those that no other has begun by the time
    it has done its own. It does all where that was quick last time and no `threads` are given.
    """
    if not count:
        return
    if count >= MOST:
        raise too_many(kernel.key, count)
    shares = thread_count(like) if threads is None else threads
    device = _device(like.device)
    load(kernel, device.alias)
    bounds = [i * count // shares for i in range(shares + 1)]
    stream = _stream(torch.cuda.current_stream(like.device)) if like.is_cuda else None

    def run(i: int) -> None:
        first, items = bounds[i], bounds[i + 1] - bounds[i]
        _call(kernel, device, first, items, records[min(i, len(records) - 1)], stream)

    # What was seen to be quick is not worth another thread.
    size = kernel, count.bit_length()
    if shares == 1:
        run(0)
    elif threads is None and _seconds.get(size, math.inf) < QUICK:
        start = perf_counter()
        _call(kernel, device, 0, count, records[0], stream)
        _seconds[size] = perf_counter() - start
    else:
        _seconds[size] = shares * _share(run, shares)


def _share(run: Callable[[int], None], threads: int) -> float:
    """Has a share run by each of `threads`; returns how long this one took for its own [s]."""
    futures = [_pool(threads).submit(run, i) for i in range(1, threads)]
    start = perf_counter()
    try:
        # The thread that asks takes the first share itself.
        run(0)
        seconds = perf_counter() - start
        # And those not begun by now: other programs may have the processor's other cores.
        for i, future in enumerate(futures, 1):
            if future.cancel():
                run(i)
    finally:
        # No memory is given up that others still write to, whatever went wrong here.
        wait([future for future in futures if not future.cancel()])
    for future in futures:
        if not future.cancelled():
            future.result()
    return seconds


def launch_later(kernel: Any, like: Tensor) -> None:
    """Has `kernel`, which will be launched where tensor `like` lies, compiled meanwhile."""
    name_kernel(kernel, _device(like.device).alias)


@functools.cache
def _start() -> None:
    """Starts Warp; what it writes of a missing CUDA driver then is kept from the user's sight.

    It does so past Python, to the process's error stream, on every machine without a GPU.
    """
    sys.stderr.flush()
    errors = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        wp.init()
    finally:
        os.dup2(errors, 2)
        os.close(errors)


@functools.cache
def _device(device: torch.device) -> Any:
    _start()
    return wp.device_from_torch(device)


def _call(kernel: Any, device: Any, first: int, items: int, record: Any, stream: Any) -> None:
    if not items:
        return
    calls = _calls(kernel, device.alias)
    try:
        call = calls.pop()
    except IndexError:
        call = wp.launch(kernel, items, [first, record], device=device, record_cmd=True)
    if call.bounds.size != items:
        call.set_dim(items)
    call.set_param_at_index_from_ctype(0, first)
    call.set_param_at_index_from_ctype(1, record)
    call.launch(stream)
    calls.append(call)


@functools.cache
def _stream(stream: Any) -> Any:
    """Warp's name of a stream of torch: finding it anew takes as long as a launch."""
    return wp.stream_from_torch(stream)


@functools.cache
def _calls(kernel: Any, device: str) -> list[Any]:
    """Launches of `kernel` that nobody is making: given anew, they take a quarter of the time."""
    return []


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "kernels")


# Threads do not live on in a process forked from this one.
os.register_at_fork(after_in_child=_pool.cache_clear)
