"""What is computed again in the backward pass has the same derivatives, and is not kept."""

import weakref

import pytest
import torch
from media import random_values
from torch import Tensor

from ddrecon.numerics.autodiff import recompute


def curved(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    return (x * y).exp() + x.sin(), x * x / (1 + y * y)


def nested(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    one, other = recompute(curved, x * y, y)
    return recompute(curved, one.sqrt(), other + x)


@pytest.mark.parametrize("function", [curved, nested])
def test_derivatives_are_those_of_what_is_kept(function) -> None:
    x, y = (random_values(3, 4, 5, seed=seed).requires_grad_() for seed in (0, 1))
    assert torch.autograd.gradcheck(
        lambda x, y: recompute(function, x, y), (x, y), check_forward_ad=True
    )


def test_the_backward_pass_may_be_made_twice() -> None:
    x, y = (random_values(3, 4, 5, seed=seed).requires_grad_() for seed in (0, 1))
    total = sum(part.sum() for part in recompute(nested, x, y))
    first, second = (torch.autograd.grad(total, (x, y), retain_graph=True) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        assert torch.equal(one, other)


def test_nothing_between_arguments_and_result_stays() -> None:
    seen: list[weakref.ref[torch.UntypedStorage]] = []

    def function(x: Tensor) -> Tensor:
        between = x.exp()
        seen.append(weakref.ref(between.untyped_storage()))
        return between * between

    x = random_values(3, 4, 5).requires_grad_()
    result = recompute(function, x)
    assert [reference() for reference in seen] == [None]
    result.sum().backward()
    assert len(seen) == 2 and [reference() for reference in seen] == [None, None]
