"""A computation on a GPU as a CUDA graph: recorded once, then replayed as a whole, in place.

A computation can be recorded if Python reads none of its numbers and hands it none, so that it is a
fixed program of tensors that stay where they are. A replay costs a processor one launch.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch

T = TypeVar("T")


class GraphRecorder:
    """Records graphs that run in turn and share their memory, which goes with the last of them."""

    def __init__(self) -> None:
        self._pool = torch.cuda.graph_pool_handle()

    def __call__(self, computation: Callable[[], T]) -> tuple[T, Callable[[], object]]:
        """What `computation` returns, not computed yet, and a function that computes it, in place.

        Each replay overwrites its tensors. Raises RuntimeError where CUDA refuses to record.
        """
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        # Constants, workspaces of libraries and modules of kernels are made in a run before.
        with torch.cuda.stream(stream):
            computation()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, pool=self._pool, capture_error_mode="thread_local"):
            result = computation()
        return result, graph.replay
