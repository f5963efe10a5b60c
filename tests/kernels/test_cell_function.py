"""Functions of a cell: values, tangents and cotangents of all of them."""

from pathlib import Path

import pytest
import torch
from graphics_cards import assert_compiles
from torch import Tensor
from torch.autograd.gradcheck import gradcheck

pytest.importorskip("warp", reason="Warp is not installed (extra `warp`)")

from ddrecon.kernels.cell_function import RowFunction, apply_cell

GAIN = "transport/fused/gain.h"
CELLS = [
    (GAIN, "Gain<1, 0, 1>", 10, 8, 6),
    (GAIN, "Gain<0, 1, 0>", 2, 2, 6),
    ("transport/fused/steep.h", "Steep", 5, 3, 7),
    ("diffusion/fused/closure.h", "Geometric<2>", 3, 1, 2),
]
"""Header, function, fields, outs, numbers."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("header", "cell", "ins", "outs", "numbers"), CELLS, ids=[cell for _, cell, *_ in CELLS]
)
def test_derivatives_are_those_of_values(
    header: str, cell: str, ins: int, outs: int, numbers: int
) -> None:
    """Fields of one color, which all share, are among them."""
    generator = torch.Generator().manual_seed(1)

    def draw(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64).add_(0.1)

    given = [draw(numbers, 2), *(draw(1 if k == 0 else 2, 2, 3, 5) for k in range(ins))]

    def find(*tensors: Tensor) -> tuple[Tensor, ...]:
        return apply_cell(header, cell, outs, *tensors)

    for each in given:
        each.requires_grad_()
    assert gradcheck(find, given, check_forward_ad=True)


def test_they_compile_for_graphics_cards(tmp_path: Path) -> None:
    kernels = [
        RowFunction(header, name, ((),) * outs, 1).kernel("tangents", ins, 32)
        for header, name, ins, outs, _ in CELLS
    ]
    assert_compiles(kernels, tmp_path)
