"""What the physics asks of automatic differentiation: whether a number is being varied, and recomputation instead of memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils.checkpoint import checkpoint

T = TypeVar("T")


def is_varied(tensor: Tensor) -> bool:
    """Whether a derivative with respect to `tensor`, or something it was made from, is being taken, in either mode."""
    return tensor.requires_grad or forward_ad.unpack_dual(tensor).tangent is not None


def recomputed(function: Callable[..., T], *arguments: object) -> T:
    """`function(*arguments)`, which must not draw random numbers: the backward pass computes it again and keeps only the arguments."""
    if not torch.is_grad_enabled():
        return function(*arguments)
    result: T = checkpoint(function, *arguments, use_reentrant=False, preserve_rng_state=False)
    return result
