"""What the physics asks of automatic differentiation: whether a number is being varied, what to keep, recomputation instead of memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils.checkpoint import checkpoint

T = TypeVar("T")


def is_varied(tensor: Tensor) -> bool:
    """Whether a derivative with respect to `tensor`, or something it was made from, is being taken, in either mode."""
    return tensor.requires_grad or forward_ad.unpack_dual(tensor).tangent is not None


def is_forward() -> bool:
    """Whether forward mode, or one of the transforms of `torch.func`, is on."""
    return forward_ad._current_level >= 0 or torch._C._are_functorch_transforms_active()


def keep(ctx: Any, *tensors: Tensor) -> None:
    """Saves `tensors` in the context of a custom function, for both modes; for forward mode only while it is on.

    Unlike what is saved for the backward pass, what is saved for forward mode stays in memory where a backward pass is to recompute it.
    """
    ctx.save_for_backward(*tensors)
    if is_forward():
        ctx.save_for_forward(*tensors)


def recomputed(function: Callable[..., T], *arguments: object) -> T:
    """`function(*arguments)`, which must not draw random numbers: the backward pass computes it again and keeps only the arguments."""
    if not torch.is_grad_enabled():
        return function(*arguments)
    result: T = checkpoint(function, *arguments, use_reentrant=False, preserve_rng_state=False)
    return result
