"""What is kept as long as the tensors stay that it was computed from."""

import gc
from weakref import ref

import numpy as np
import pytest
import torch
from far_device import FAR
from torch import Tensor

from ddrecon.numerics import remember as module
from ddrecon.numerics.remember import forget_changed, is_any_nonzero, remember


@pytest.fixture
def doubled():
    calls = []

    @remember
    def double(values: Tensor, times: int = 2) -> Tensor:
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
