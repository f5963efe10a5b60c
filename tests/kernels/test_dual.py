"""Tangents of kernels are those of what their texts compute."""

import pytest
import torch
from media import random_values
from torch import Tensor

pytest.importorskip("warp")


from ddrecon.kernels.dual import interleaved_tangent_of, pair, tangent_of, with_changes
from ddrecon.kernels.text import BLOCK, TextKernel

COUNT = 37
MADE = "half out other"
GIVEN = "int length, total; F shift, *x, *y, *half, *out, *other"
TEXT = """
const F *first = x, two = F(2), *second = y;
F* const outs[2] = {out, other};
F* __restrict kept = half + 0;
auto bent = [](F a, const F* from, int i) -> F { return a < F(0) ? -a * a : from[i] / (F(1) + a); };
INDEPENDENT
for (int i = begin; i < end; ++i) {
    const F depth = first[i] * first[i];
    kept[i] = F(0.5) * depth;
    const F thin = depth < F(0.5) ? psi_series(depth) : (F(1) - decay(depth)) / depth;
    outs[0][i] = decay(depth) * wp::sqrt(depth + shift) + thin * second[i];
    outs[1][i] = bent(first[i], y, i) - two * kept[i];
}
"""


def plain(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    depth = x * x
    psi = (1 - (1 - torch.exp(-depth)) / depth) / depth
    thin = torch.where(depth < 0.5, psi, (1 - torch.exp(-depth)) / depth)
    out = torch.exp(-depth) * torch.sqrt(depth + 0.25) + thin * y
    return out, torch.where(x < 0, -x * x, y / (1 + x)) - depth


@pytest.fixture(scope="module")
def kernel() -> TextKernel:
    return TextKernel("bend", 64, BLOCK + TEXT, GIVEN, MADE)


def numbers() -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Values of `x` are from 0.2 on, of either sign: `plain` divides by them."""
    x, y, d_x, d_y = (2 * random_values(COUNT, seed=seed) - 1 for seed in range(4))
    return (x + 0.2 * x.sign(), y), (d_x, d_y)


@pytest.mark.slow
def test_changes_are_those_of_the_text(kernel: TextKernel) -> None:
    values, changes = numbers()
    known = torch.func.jvp(plain, values, changes)[1]
    given = dict(zip("xy", values, strict=True)) | {"shift": 0.25, "length": COUNT, "total": COUNT}
    d_given = with_changes(given, dict(zip("xy", changes, strict=True)))
    half, d_half, d_out, d_other = (torch.empty_like(values[0]) for _ in range(4))
    made = {"d_out": d_out, "d_other": d_other, "d_half": d_half, "half": half}
    tangent_of(kernel, "half").launch(1, given | d_given, made)
    for one, other in zip((d_out, d_other), known, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-11)
    assert torch.equal(half, 0.5 * values[0] ** 2)


@pytest.mark.slow
def test_pairs_of_value_and_change_are_numbers_too() -> None:
    """Of a text that declares no lists of pointers."""
    text = TEXT.replace("F* const outs[2] = {out, other};", "F* outs[2] = {out, other};")
    kernel = TextKernel("bend_pairs", 64, BLOCK + text, GIVEN, MADE)
    values, changes = numbers()
    arrays = {name: pair(*both) for name, *both in zip("xy", values, changes, strict=True)}
    found = {name: torch.empty(COUNT, 2, dtype=torch.float64) for name in ("out", "other", "half")}
    given = arrays | {"shift": 0.25, "length": COUNT, "total": COUNT}
    interleaved_tangent_of(kernel).launch(1, given, found)
    known = zip(plain(*values), torch.func.jvp(plain, values, changes)[1], strict=True)
    for name, both in zip(("out", "other"), known, strict=True):
        torch.testing.assert_close(found[name], torch.stack(both, -1), rtol=1e-11, atol=1e-11)


def test_arrays_without_change_have_changes_of_zero() -> None:
    (x, y), (d_x, _) = numbers()
    found = with_changes({"x": x, "y": y[:5], "count": 3}, {"x": d_x[:1]})
    assert torch.equal(found["d_x"], d_x[:1].expand(COUNT))
    assert not found["d_y"].any() and len(found["d_y"]) >= 5 and "d_count" not in found


def test_lists_of_arrays_are_refused() -> None:
    listed = TextKernel("listed", 64, "out[item] = fields[0][item];", "F *fields[2], *out", "out")
    for find in (lambda: tangent_of(listed), lambda: interleaved_tangent_of(listed)):
        with pytest.raises(ValueError, match="fields"):
            find()
