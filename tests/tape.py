"""A processor's twin of a CUDA graph: the operations of a computation, made again in their order.

What a graph could not be is refused: a number that Python reads, and a tensor made of Python's.
"""

from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

READS = {"_local_scalar_dense", "nonzero", "masked_select", "_unique2", "unique_dim"}
WRITES = {"lift_fresh"}
INDEXED = {"index", "index_put", "index_put_", "_index_put_impl_"}


class Tape(TorchDispatchMode):
    """Operations and launches, `steps`, as functions that make them again in place."""

    def __init__(self) -> None:
        super().__init__()
        self.steps: list[Callable[[], None]] = []
        self.alive: list[Any] = []

    def __torch_dispatch__(
        self, function: Any, types: Any, arguments: Any = (), options: Any = None
    ) -> Any:
        name = function._schema.name.removeprefix("aten::")
        is_masked = name in INDEXED and any(
            index is not None and index.dtype == torch.bool for index in arguments[1]
        )
        if name in READS | WRITES or is_masked:
            raise RuntimeError(f"{name} is no part of a graph")
        options = options or {}
        result = function(*arguments, **options)
        # What is a view of an argument, or has no numbers yet, is made once.
        known = {_address(tensor) for tensor in _tensors([arguments, options])}
        is_view = all(_address(tensor) in known for tensor in _tensors(result))
        self.alive.append([arguments, options, result])
        if name.startswith("empty") or (is_view and not function._schema.is_mutable):
            return result

        def repeat() -> None:
            plain, named = tree_map_only(Tensor, _plain, (arguments, options))
            again = function(*plain, **named)
            for tensor, new in zip(_tensors(result), _tensors(again), strict=True):
                if _address(tensor) != _address(new):
                    tensor.data.copy_(new)

        self.steps.append(repeat)
        return result

    def replay(self) -> None:
        with torch.no_grad():
            for step in self.steps:
                step()


def record(computation: Callable[[], Any]) -> tuple[Any, Callable[[], None]]:
    """As `ddrecon.reconstruct.gradients.GraphRecorder`, on a processor."""
    from ddrecon.kernels import launch  # imports Warp

    computation()
    tape, call = Tape(), launch._call

    def call_again(
        kernel: Any, device: Any, first: int, items: int, record: Any, stream: Any
    ) -> None:
        # A kernel's record may be changed for its next launch.
        copy = type(record).from_buffer_copy(record)
        tape.alive.append(record)
        tape.steps.append(lambda: call(kernel, device, first, items, copy, stream))
        call(kernel, device, first, items, record, stream)

    with tape, patch.object(launch, "_call", call_again):
        result = computation()
    return result, tape.replay


def _tensors(values: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(values) if isinstance(leaf, Tensor)]


def _address(tensor: Tensor) -> int:
    return tensor.untyped_storage().data_ptr()


def _plain(tensor: Tensor) -> Tensor:
    """The same numbers, whose changes autograd does not count."""
    return tensor.data
