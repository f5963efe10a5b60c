"""What the physics asks of automatic differentiation: whether a number is being varied, what to
keep, recomputation instead of memory.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.autograd.graph import saved_tensors_hooks

T = TypeVar("T")


def is_varied(tensor: Tensor) -> bool:
    """Whether a derivative with respect to `tensor`, or something it was made from, is being taken,
    in either mode.
    """
    return tensor.requires_grad or forward_ad.unpack_dual(tensor).tangent is not None


def is_forward() -> bool:
    """Whether forward mode, or one of the transforms of `torch.func`, is on."""
    return forward_ad._current_level >= 0 or torch._C._are_functorch_transforms_active()


def keep(ctx: Any, *tensors: Tensor) -> None:
    """Saves `tensors` in the context of a custom function, for both modes; for forward mode only
    while it is on.

    Unlike what is saved for the backward pass, what is saved for forward mode stays in memory where
    a backward pass is to recompute it.
    """
    ctx.save_for_backward(*tensors)
    if is_forward():
        ctx.save_for_forward(*tensors)


def recompute(function: Callable[..., T], *arguments: object) -> T:
    """`function(*arguments)`, which must not draw random numbers: the backward pass computes it
    again and keeps only the arguments.

    What `torch.utils.checkpoint` does, without importing torch's compiler, which takes two seconds
    of every run.
    """
    if not torch.is_grad_enabled():
        return function(*arguments)
    again = _Again(lambda: function(*arguments))
    with saved_tensors_hooks(again.pack, again.unpack):
        return function(*arguments)


class _Again:
    """Numbers in place of the tensors that `function` saves for its backward pass, and these
    tensors when they are asked for.
    """

    def __init__(self, function: Callable[[], object]):
        self.function = function
        self.count = 0
        self.made: dict[int, Tensor] = {}

    def pack(self, _: Tensor) -> int:
        self.count += 1
        return self.count - 1

    def unpack(self, number: int) -> Tensor:
        if number not in self.made:
            self._make()
        return self.made.pop(number)

    def _make(self) -> None:
        made: list[Tensor] = []
        with (
            torch.enable_grad(),
            saved_tensors_hooks(lambda tensor: made.append(tensor.detach()), made.__getitem__),
        ):
            self.function()
        self.made = dict(enumerate(made))
