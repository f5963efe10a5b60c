"""Kernels that are a text in C++: what they are given arrives, whatever threads launch them."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
from media import random_values

pytest.importorskip("warp")

from ddrecon.errors import UsageError
from ddrecon.kernels.text import TextKernel, cut, include

TEXT = """
const int begin = item * length, end = begin + length < total ? begin + length : total;
for (int i = begin; i < end; ++i) {
    F sum = shift;
    for (int k = 0; k < 2; ++k) if (fields[k]) sum += weights[k] * fields[k][i];
    out[i] = sum;
    is_large[i] = sum > F(1);
}
"""
DECLARED = "int length, total; F shift, *fields[2], *out; double *weights; bool *is_large"
FIELDS, WEIGHTS = random_values(2, 37), random_values(2, seed=1)


@pytest.fixture(scope="module")
def kernel():
    return TextKernel("weighted_sum", 64, TEXT, DECLARED, "out is_large")


def inputs(fields=FIELDS, shift=0.0, length=1):
    """For an item each, or for one with all 37."""
    return {
        "total": 37,
        "fields": list(fields),
        "weights": WEIGHTS,
        "shift": shift,
        "length": length,
    }


def outputs():
    return {
        "out": torch.empty(37, dtype=torch.float64),
        "is_large": torch.empty(37, dtype=torch.bool),
    }


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_arrays_numbers_and_lists_arrive(kernel, threads):
    items, length = cut(37, 4, WEIGHTS)
    results = outputs()
    strided = [random_values(37, 2)[:, 0], FIELDS[1].float()]  # copied and converted first
    kernel.launch(items, inputs(strided, 0.5, length), results, threads)
    known = 0.5 + WEIGHTS[0] * strided[0] + WEIGHTS[1] * strided[1].double()
    torch.testing.assert_close(results["out"], known, rtol=1e-14, atol=0)
    assert torch.equal(results["is_large"], results["out"] > 1)


@pytest.mark.slow
def test_none_is_an_array_that_is_not_there(kernel):
    results = outputs()
    kernel.launch(1, inputs([None, FIELDS[1]], length=37), results)
    torch.testing.assert_close(results["out"], WEIGHTS[1] * FIELDS[1], rtol=1e-14, atol=0)


@pytest.mark.slow
def test_each_share_writes_to_its_own(kernel):
    shares = [outputs() for _ in range(3)]
    kernel.launch(37, inputs(), shares[0], shares=shares)
    known, bounds = WEIGHTS @ FIELDS, [0, 12, 24, 37]
    for share, first, last in zip(shares, bounds, bounds[1:], strict=False):
        torch.testing.assert_close(share["out"][first:last], known[first:last])


@pytest.mark.slow
def test_threads_launch_the_same_kernel_at_once(kernel):
    """Each has a recorded launch for itself while it lasts."""

    def run(seed):
        fields, results = random_values(2, 37, seed=seed), outputs()
        kernel.launch(37, inputs(fields), results, threads=1)
        return torch.allclose(results["out"], WEIGHTS @ fields, rtol=1e-14)

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(run, range(200)))


@pytest.mark.slow
def test_a_bound_kernel_takes_other_numbers(kernel):
    results = outputs()
    bound = kernel.bind(inputs(length=37), results)
    for shift in (0.0, 2.0):
        bound.launch(1, shift=shift)
        torch.testing.assert_close(results["out"], WEIGHTS @ FIELDS + shift)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"out": torch.empty(37)}, "out is declared as torch.float64"),
        ({"out": torch.empty(37, 2, dtype=torch.float64)[:, 0]}, "is to be contiguous"),
        ({"other": torch.empty(37)}, "other"),
        ({"shift": 3}, "shift"),
    ],
    ids=["type", "stride", "array", "number"],
)
def test_what_does_not_fit_is_refused(kernel, wrong, message):
    with pytest.raises(ValueError, match=message):
        kernel.launch(1, inputs(), outputs() | wrong)


def test_what_it_writes_is_handed_over_as_outputs(kernel):
    """A copy of it, were it not contiguous, would be written to in vain."""
    results = outputs()
    wrong = inputs() | {"out": results.pop("out")}
    with pytest.raises(ValueError, match="out"):
        kernel.launch(1, wrong, results)
    with pytest.raises(ValueError, match="shift"):
        kernel.launch(1, {"length": 37}, outputs() | {"shift": 3})


@pytest.mark.slow
def test_what_it_only_reads_it_cannot_write(capfd):
    kernel = TextKernel("read_alone", 64, "x[item] = out[item];", "F *x, *out", "out")
    x, out = torch.ones(2, 1, dtype=torch.float64)
    with pytest.raises(Exception, match="build failed"):
        kernel.launch(1, {"x": x}, {"out": out})
    assert "const-qualified" in capfd.readouterr().err


@pytest.mark.slow
def test_rows_of_many_rays_begin_beyond_the_numbers_of_an_int():
    text = "Arguments<F> rays = {}; rays.ray_count = ray_count; place[item] = rays.row_of(row);"
    found = torch.empty(1, dtype=torch.int64)
    given = "int ray_count, row; long *place"
    kernel = TextKernel("find_row", 32, text, given, "place", "march/fused/rays.h")
    kernel.launch(1, {"ray_count": 33_000_000, "row": 71}, {"place": found})
    assert found.item() == 33_000_000 * 71 > 2**31


def test_where_the_package_lies_is_no_part_of_a_kernel():
    """So other checkouts find it compiled."""
    options = vars(include("transport/fused/gain.h"))
    assert str(Path(__file__).parents[2]) not in repr(options)
    assert options["extra_cpu_preamble"].count("struct Dual {") == 1


def test_counts_beyond_the_numbers_of_an_int_are_refused(kernel):
    for count, numbers in ((2**31, {}), (1, {"total": 2**32 + 1})):
        with pytest.raises(UsageError, match=r"2\^31"):
            kernel.launch(count, inputs() | numbers, outputs(), threads=1)
