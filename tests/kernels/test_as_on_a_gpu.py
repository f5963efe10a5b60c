"""What kernels compute does not depend on whether an item is a cell, nor on the order of items."""

from pathlib import Path

import pytest
import torch
from scenes import cloud, mixture, smoke
from twins import assert_same, differentiate, images_of, values_of

from ddrecon.scene import Scene
from ddrecon.variables.values import variable_names

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from as_on_a_gpu import ORDERS, as_on_a_gpu, headers_of

from ddrecon.kernels.text import TextKernel

PACKAGE = Path(__file__).parents[2] / "ddrecon"
MOVES = "camera", "focal", "principal_point", "direction", "position"
"""Ends of names of variables that move rays, beams and lamps."""


def variables_of(scene: Scene, moves: bool) -> list[str]:
    """All but those that others are made of; with `MOVES` if it `moves`."""
    names = (name for name in variable_names(scene) if name not in ("sigma_t", "albedo"))
    return [name for name in names if moves or not name.endswith(MOVES)]


@pytest.mark.slow
def test_every_kernel_comes_to_the_same_bits_in_any_order() -> None:
    headers: set[str] = set()
    for scene, moves in ((smoke(), False), (cloud(), True), (mixture(), True)):
        case = images_of(scene), values_of(scene, variables_of(scene, moves)), True
        known, results = differentiate("torch", *case), []
        for order in ORDERS:
            with as_on_a_gpu(order) as launched:
                results.append(differentiate("warp", *case))
            headers |= headers_of(launched)
        assert_same(results[0], known, 1e-12)
        for result in results[1:]:
            assert_same(result, results[0], 0.0)
    assert {str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.h")} <= headers


def test_an_item_that_reads_what_another_writes_is_seen() -> None:
    text = "sums[item] = field[item] + (item ? sums[item - 1] : 0);"
    kernel = TextKernel("race", 64, text, "F *field, *sums", "sums")
    field, found = torch.ones(9, dtype=torch.float64), []
    for order in ORDERS:
        sums = torch.zeros_like(field)
        with as_on_a_gpu(order):
            kernel.launch(len(field), {"field": field}, {"sums": sums})
        found.append(float(sums.sum()))
    assert len(set(found)) == len(ORDERS)
