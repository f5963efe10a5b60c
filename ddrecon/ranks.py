"""Ranks: the processes that share the work of one run, as torchrun starts them.

Each computes a share, and the shares are summed. Without torchrun, or with a single process of it,
there is one rank: nothing is imported, nothing is exchanged.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from io import BytesIO
from typing import TYPE_CHECKING, TypeVar

from ddrecon.errors import RanksError, one_line

if TYPE_CHECKING:
    from torch import Tensor

MEET_SECONDS = 120.0
"""Seconds that ranks wait for each other at the start, unless `MEET_VARIABLE` says otherwise."""
MEET_VARIABLE = "DDRECON_MEET_SECONDS"
EXCHANGE_SECONDS = 1800.0
"""Seconds that ranks wait in an exchange; a rank that has ended is noticed at once."""

T = TypeVar("T")

_rank, _count = 0, 1
"""Number and count of this process; it is alone until it has joined others."""


def join_ranks(has_gpu: bool) -> None:
    """Meets the other ranks where torchrun has started several; nothing happens elsewhere.

    With `has_gpu`, exchanges of tensors on a GPU go by NCCL; all else goes by gloo. Raises
    RanksError where the others cannot be reached.
    """
    global _rank, _count
    if _count > 1 or int(os.environ.get("WORLD_SIZE", 1)) < 2 or "RANK" not in os.environ:
        return
    import torch.distributed as dist

    rank, count = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
    seconds = float(os.environ.get(MEET_VARIABLE, MEET_SECONDS))
    keys = [f"rank {number}" for number in range(count)]
    try:
        store, *_ = next(dist.rendezvous("env://", timeout=timedelta(seconds=seconds)))
        store = dist.PrefixStore("ddrecon", store)
        store.set(keys[rank], "is there")
        store.wait(keys, timedelta(seconds=seconds))
        backend, limit = "cpu:gloo,cuda:nccl" if has_gpu else "gloo", EXCHANGE_SECONDS
        dist.init_process_group(
            backend, store=store, rank=rank, world_size=count, timeout=timedelta(seconds=limit)
        )
    except (RuntimeError, ValueError, OSError) as error:
        address = ":".join(os.environ.get(f"MASTER_{name}", "?") for name in ("ADDR", "PORT"))
        raise RanksError(
            f"rank {rank} of {count} cannot meet the others at {address} within {seconds:g} s "
            f"({_reason(error)}); check MASTER_ADDR, MASTER_PORT and torchrun's rendezvous; "
            "GLOO_SOCKET_IFNAME and NCCL_SOCKET_IFNAME name the network to use"
        ) from error
    _rank, _count = rank, count


def leave_ranks() -> None:
    """Parts from the other ranks, which need not do so at the same time."""
    global _rank, _count
    if _count > 1:
        import torch.distributed

        _rank, _count = 0, 1
        torch.distributed.destroy_process_group()


def rank_count() -> int:
    """How many ranks share the work."""
    return _count


def own_rank() -> int:
    """The number of this rank, from 0."""
    return _rank


def is_first() -> bool:
    """Whether this is the rank that writes and prints."""
    return _rank == 0


@contextmanager
def alone() -> Iterator[None]:
    """Has each rank work by itself, as if there were no others."""
    global _rank, _count
    before, (_rank, _count) = (_rank, _count), (0, 1)
    try:
        yield
    finally:
        _rank, _count = before


def sum_over_ranks(tensors: Sequence[Tensor]) -> list[Tensor]:
    """The sums over ranks of each of `tensors`, of one device: the same bits on all of them.

    They go in one exchange. Raises RanksError where a rank has ended.
    """
    if _count == 1 or not tensors:
        return list(tensors)
    import torch

    flat = torch.cat([tensor.detach().flatten() for tensor in tensors])
    with _exchange():
        torch.distributed.all_reduce(flat)
        if flat.is_cuda:
            torch.cuda.synchronize(flat.device)
    sums = flat.split([tensor.numel() for tensor in tensors])
    return [total.view_as(like).to(like.dtype) for total, like in zip(sums, tensors, strict=True)]


def sum_numbers(numbers: Sequence[float]) -> list[float]:
    """The sums over ranks of each of `numbers`."""
    if _count == 1:
        return list(numbers)
    import torch

    sums: list[float] = sum_over_ranks([torch.tensor(numbers, dtype=torch.float64)])[0].tolist()
    return sums


def is_any(flag: bool) -> bool:
    """Whether `flag` is true on any rank."""
    return sum_numbers([flag])[0] > 0


def from_first(value: T) -> T:
    """The `value` that the first rank has: plain values and tensors, these on the processor."""
    if _count == 1:
        return value
    import torch

    # As a file of tensors and plain values: what is read can run no code.
    stream = BytesIO()
    if _rank == 0:
        torch.save(value, stream)
    content = torch.frombuffer(bytearray(stream.getvalue() or b"0"), dtype=torch.uint8)
    size = torch.tensor(len(content))
    with _exchange():
        torch.distributed.broadcast(size, 0)
        content = content if _rank == 0 else content.new_empty(int(size))
        torch.distributed.broadcast(content, 0)
    copy: T = torch.load(BytesIO(content.numpy().tobytes()), map_location="cpu", weights_only=True)
    return copy


@contextmanager
def _exchange() -> Iterator[None]:
    """An exchange, whose error becomes a RanksError: another rank has ended."""
    try:
        yield
    except RuntimeError as error:
        raise RanksError(f"another rank has ended ({_reason(error)})") from error


def tell_failure(error: BaseException) -> str | None:
    """What this rank is to print as it ends by `error`; None where another says the same."""
    text = str(error)
    if _count > 1 and isinstance(error, RanksError):
        # All ranks have lost the one that failed: it is told once a machine.
        return text if os.environ.get("LOCAL_RANK", "0") == "0" else None
    return f"rank {_rank}: {text}" if _rank else text


def _reason(error: BaseException) -> str:
    """The first sentence of what torch says, without where in its source that was."""
    line = str(error).partition("\n")[0].partition(". ")[0]
    return one_line(line.rpartition("] ")[2] or line if line.startswith("[") else line).rstrip(".")
