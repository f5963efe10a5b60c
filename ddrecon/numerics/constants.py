"""Python's numbers as tensors, written to a device once: each write makes a processor wait."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor


def constant(numbers: Sequence[float], like: Tensor) -> Tensor:
    """`numbers` as a tensor [N] of the type and on the device of `like`; nobody may change it."""
    return _write(tuple(numbers), like.dtype, like.device)


@functools.lru_cache(maxsize=4096)
def _write(numbers: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(numbers, dtype=dtype, device=device)
