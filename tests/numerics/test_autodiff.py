"""What is computed again in the backward pass, and what is kept as long as its tensors stay."""

import gc
import weakref
from contextlib import nullcontext
from weakref import ref

import numpy as np
import pytest
import torch
from far_device import FAR
from media import random_values
from torch.autograd import forward_ad

from ddrecon.numerics import remember as module
from ddrecon.numerics.autodiff import recompute
from ddrecon.numerics.interpolation import sample_volume
from ddrecon.numerics.remember import constant, forget_changed, is_any_nonzero, remember


def curved(x, y):
    return (x * y).exp() + x.sin(), x * x / (1 + y * y)


def nested(x, y):
    one, other = recompute(curved, x * y, y)
    return recompute(curved, one.sqrt(), other + x)


@pytest.mark.parametrize("function", [curved, nested])
def test_derivatives_are_those_of_what_is_kept(function):
    x, y = (random_values(3, 4, 5, seed=seed).requires_grad_() for seed in (0, 1))
    assert torch.autograd.gradcheck(
        lambda x, y: recompute(function, x, y), (x, y), check_forward_ad=True
    )


def test_the_backward_pass_may_be_made_twice():
    x, y = (random_values(3, 4, 5, seed=seed).requires_grad_() for seed in (0, 1))
    total = sum(part.sum() for part in recompute(nested, x, y))
    first, second = (torch.autograd.grad(total, (x, y), retain_graph=True) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("is_forward", [True, False])
def test_forward_mode_may_begin_or_end_before_the_backward_pass(is_forward):
    """There interpolation goes another way."""
    values, points = random_values(2, 3, 4, 5), 2 * random_values(3, 6, 3, seed=1) - 1
    way, leaf = random_values(2, 3, 4, 5, seed=2), values.clone().requires_grad_()
    (known,) = torch.autograd.grad(sample_volume(leaf, points).square().sum(), leaf)
    with forward_ad.dual_level() if is_forward else nullcontext():
        varied = forward_ad.make_dual(leaf, way) if is_forward else leaf
        total = recompute(sample_volume, varied, points).square().sum()
        total, change = forward_ad.unpack_dual(total)
    with nullcontext() if is_forward else forward_ad.dual_level():
        (bar,) = torch.autograd.grad(total, leaf)
    torch.testing.assert_close(bar, known)
    if is_forward:
        torch.testing.assert_close(change.detach(), (known * way).sum())


def test_nothing_between_arguments_and_result_stays():
    seen: list[weakref.ref[torch.UntypedStorage]] = []

    def function(x):
        between = x.exp()
        seen.append(weakref.ref(between.untyped_storage()))
        return between * between

    x = random_values(3, 4, 5).requires_grad_()
    result = recompute(function, x)
    assert [reference() for reference in seen] == [None]
    result.sum().backward()
    assert len(seen) == 2 and [reference() for reference in seen] == [None, None]


@pytest.fixture
def doubled():
    calls = []

    @remember
    def double(values, times=2):
        calls.append(times)
        return times * values

    return double, calls


def test_the_same_arguments_are_computed_once(doubled):
    double, calls = doubled
    values = torch.ones(3)
    assert double(values) is double(values)
    assert torch.equal(double(values, 3), 3 * values)
    assert calls == [2, 3]


CHANGES = {
    "in place": lambda values: values.add_(1),
    "by data": lambda values: values.data.add_(1),
    "as data": lambda values: setattr(values, "data", values + 1),
    "in NumPy": lambda values: np.add(values.numpy(), 1, out=values.numpy()),
    "of another kind": lambda values: setattr(values, "data", values.double() + 1),
}


@pytest.mark.parametrize("count", [1, 3, 5000])
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_what_was_changed_is_computed_again(doubled, change, count):
    double, calls = doubled
    values = torch.ones(count)
    double(values)
    change(values)
    assert torch.equal(double(values), torch.full_like(values, 4.0))
    assert len(calls) == 2


def test_what_follows_from_a_result_follows_its_changes(doubled):
    double, calls = doubled
    values = torch.ones(3)
    assert double(double(values)) is double(double(values))
    values.data.add_(1)
    assert torch.equal(double(double(values)), torch.full((3,), 8.0))
    assert len(calls) == 4


def test_on_a_gpu_one_look_finds_what_changed(doubled):
    """There each call would wait for the device, so those who are given tensors look first."""
    double, calls = doubled
    tensors = [torch.ones(3).to(FAR), torch.ones(2, 2).double().to(FAR)]
    for change, count in ((0, 2), (1, 4)):
        tensors[1].near.add_(change)  # what nobody counts
        forget_changed()
        for values in tensors:
            assert double(values).tolist() == (2 * values.near).tolist()
        assert len(calls) == count


def test_other_tensors_of_the_same_numbers_are_others(doubled):
    double, calls = doubled
    for number in range(20):  # memory and identities are used again
        assert float(double(torch.full((3,), float(number)))[0]) == 2 * number
    assert len(calls) == 20


def test_what_is_varied_is_not_kept(doubled):
    double, calls = doubled
    values = torch.ones(3, requires_grad=True)
    double(values).sum().backward()
    double(values).sum().backward()
    assert torch.equal(values.grad, torch.full((3,), 4.0))
    assert len(calls) == 2


def test_tangents_pass(doubled):
    double, _ = doubled
    values, change = torch.ones(3), torch.arange(3.0)
    double(values)
    assert torch.equal(torch.func.jvp(double, (values,), (change,))[1], 2 * change)


def test_a_result_goes_with_its_tensors(doubled):
    double, _ = doubled
    values = torch.ones(3)
    result = ref(double(values))
    assert result() is not None
    del values
    gc.collect()
    assert result() is None


def test_what_was_found_in_inference_mode_serves_derivatives(doubled):
    double, _ = doubled
    values, other = torch.ones(3), torch.ones(3, requires_grad=True)
    with torch.inference_mode():
        double(values)
    (other * double(values)).sum().backward()
    assert torch.equal(other.grad, torch.full((3,), 2.0))


def test_constants_of_inference_mode_serve_derivatives():
    leaf = torch.ones(3, requires_grad=True)
    with torch.inference_mode():
        numbers = constant((0.3, 7.1, 2.9), leaf)
    (leaf * numbers).sum().backward()
    assert torch.equal(leaf.grad, numbers)


def test_more_than_there_is_room_for_is_not_kept(doubled, monkeypatch):
    double, calls = doubled
    monkeypatch.setattr(module, "MOST_BYTES", 0)
    values = torch.ones(3)
    double(values)
    double(values)
    assert len(calls) == 2


def test_one_number_counts():
    values = torch.zeros(3)
    assert not is_any_nonzero(values)
    values[1] = 1
    assert is_any_nonzero(values)
