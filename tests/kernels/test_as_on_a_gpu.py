"""What kernels compute does not depend on whether an item is a cell, nor on the order of items."""

from pathlib import Path

import pytest
import torch
from fixed_order import FixedOrder
from scenes import cloud, mixture, smoke
from torch.nn.functional import interpolate
from twins import assert_same, differentiate, images_of, values_of

from ddrecon.engine import use_engine
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.setup import scene_at_level
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import variable_names

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from as_on_a_gpu import ORDERS, as_on_a_gpu, headers_of

from ddrecon.kernels.text import TextKernel

PACKAGE = Path(__file__).parents[2] / "ddrecon"
CONFIGS = PACKAGE.with_name("configs")
MOVES = "camera", "focal", "principal_point", "direction", "position"
"""Ends of names of variables that move rays, beams and lamps."""


def variables_of(scene, moves):
    """All but those that others are made of; with `MOVES` if it `moves`."""
    names = (name for name in variable_names(scene) if name not in ("sigma_t", "albedo"))
    return [name for name in names if moves or not name.endswith(MOVES)]


@pytest.mark.slow
def test_every_kernel_comes_to_the_same_bits_in_any_order():
    headers: set[str] = set()
    for scene, moves in ((smoke(), False), (cloud(), True), (mixture(), True)):
        case = images_of(scene), values_of(scene, variables_of(scene, moves))
        known, results = differentiate("torch", *case, has_tangent=True), []
        with as_on_a_gpu(), FixedOrder():
            differentiate("warp", *case)
        for order in ORDERS:
            with as_on_a_gpu(order) as launched:
                results.append(differentiate("warp", *case, has_tangent=True))
            headers |= headers_of(launched)
        assert_same(results[0], known, 1e-12)
        for result in results[1:]:
            assert_same(result, results[0], 0.0)
    assert {str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.h")} <= headers


@pytest.mark.slow
@pytest.mark.parametrize("name", ["satellite", "smoke_sky", "fire", "cumulus_field"])
def test_no_sum_of_an_iteration_ends_in_any_order(name):
    """With a ground, a sky by its map, a loss by noise, a medium that repeats."""
    use_engine("warp")
    scene = load_scene(CONFIGS / f"{name}.yaml")
    with as_on_a_gpu():
        run = Reconstruction(scene_at_level(scene, max(scene.volume.grid.shape) // 10))
        with FixedOrder():
            run.step()


def test_sums_in_any_order_are_refused():
    field = torch.rand(1, 1, 2, 2, 2, requires_grad=True)
    once, twice, ones = torch.tensor([0, 2]), torch.tensor([1, 1]), torch.ones(2)
    with FixedOrder():
        torch.zeros(3).index_add(0, once, ones)
        torch.zeros(3).index_put((twice,), ones, accumulate=True)
        with pytest.raises(RuntimeError, match="index_add"):
            torch.zeros(3).index_add(0, twice, ones)
        with pytest.raises(RuntimeError, match="index_put"):
            torch.zeros(3).index_put((twice,), ones)
        with pytest.raises(RuntimeError, match="upsample"):
            interpolate(field, (3, 3, 3), mode="trilinear").sum().backward()


def test_kernels_add_whole_numbers_alone():
    """Texts have one atomic operation, whose sum has no order."""
    texts = (path.read_text() for path in PACKAGE.rglob("*") if path.suffix in (".h", ".py"))
    atomics = [line.strip() for text in texts for line in text.splitlines() if "atomicA" in line]
    (add,) = atomics
    assert add.startswith("atomicAdd((unsigned long long*)")
    assert not any("atomic_" in path.read_text() for path in PACKAGE.rglob("*.h"))


def test_an_item_that_reads_what_another_writes_is_seen():
    text = "sums[item] = field[item] + (item ? sums[item - 1] : 0);"
    kernel = TextKernel("race", 64, text, "F *field, *sums", "sums")
    field, found = torch.ones(9, dtype=torch.float64), []
    for order in ORDERS:
        sums = torch.zeros_like(field)
        with as_on_a_gpu(order):
            kernel.launch(len(field), {"field": field}, {"sums": sums})
        found.append(float(sums.sum()))
    assert len(set(found)) == len(ORDERS)
