"""A computation on a GPU as a CUDA graph: recorded once, then replayed as a whole, in place.

That it may: nothing of it is read by Python, and nothing comes from Python's numbers, so that it is
a fixed program of tensors that stay where they are. `Watch` finds out whether that is so, on any
machine. The recording itself has never run on a GPU yet: none was at hand.
"""

from __future__ import annotations

import functools
import traceback
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

T = TypeVar("T")
Record = Callable[[Callable[[], T]], tuple[T, Callable[[], None]]]
"""What a computation returns when it is recorded, and a function that replays it."""
READS = {"_local_scalar_dense", "nonzero", "masked_select", "equal", "_unique2", "unique_dim"}
"""Operations of torch whose result, or its size, a processor waits for."""
INDEXED = "index", "index_put", "index_put_", "_index_put_impl_"
"""Operations that take indices, or masks, whose sum is a size."""


class NotFixedError(Exception):
    """A computation is no fixed program of its tensors, or a replay of it is not what it was."""


class Watch(TorchDispatchMode):
    """Raises NotFixedError where a processor would wait for a GPU, or hand numbers to it."""

    def __torch_dispatch__(
        self, function: Any, types: Any, arguments: Any = (), options: Any = None
    ) -> Any:
        if (what := exchange(function, arguments, options or {})) is not None:
            raise NotFixedError(f"{what} in {_place()}")
        return function(*arguments, **(options or {}))


def exchange(function: Any, arguments: Sequence[Any], options: Mapping[str, Any]) -> str | None:
    """How an operation makes a processor and a GPU wait for each other; None if it does not."""
    name = function._schema.name.removeprefix("aten::")
    tensors = [one for one in chain(arguments, options.values()) if isinstance(one, Tensor)]
    is_there = any(not _is_host(tensor.device) for tensor in tensors)
    if name in READS and is_there:
        return f"{name} reads numbers"
    if name in INDEXED:
        parts = [part for part in arguments[1] if isinstance(part, Tensor)]
        if is_there and any(part.dtype in (torch.bool, torch.uint8) for part in parts):
            return f"{name} by a mask reads its size"
        if is_there and any(_is_host(part.device) for part in parts):
            return f"{name} is handed Python's indices"
    if name == "lift_fresh" and is_there:
        return "Python's numbers become a tensor"
    if name in ("copy_", "_to_copy"):
        target = options.get("device") or arguments[0].device
        source = arguments[1] if name == "copy_" else arguments[0]
        if _is_host(torch.device(target)) != _is_host(source.device):
            return f"{name} from one memory to another"
    return None


def _place() -> str:
    """The file of ddrecon that is at work."""
    files = [line.filename for line in traceback.extract_stack() if "/ddrecon/" in line.filename]
    own = [file.rpartition("/ddrecon/")[2] for file in files if file != __file__]
    return own[-1] if own else "torch"


def _is_host(device: torch.device) -> bool:
    return device.type == "cpu"


def record_graph(computation: Callable[[], T]) -> tuple[T, Callable[[], None]]:
    """What `computation` returns, not computed yet, and a function that computes it, in place.

    Its tensors are overwritten with each replay. Raises NotFixedError where the computation is no
    fixed program, RuntimeError where a GPU's driver refuses.
    """
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    # What is made once is made before: constants, workspaces of libraries, kernels loaded.
    with torch.cuda.stream(stream):
        computation()
        with Watch():
            computation()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, pool=_pool()):
        made = computation()
    return made, graph.replay


@functools.cache
def _pool() -> Any:
    """The memory of all graphs, which run in turn; what later ones read of others is not freed."""
    return torch.cuda.graph_pool_handle()
