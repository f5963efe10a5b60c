"""The polynomials of E13 by a fused kernel are those by PyTorch's operations."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from ddrecon.engine import ENGINES, use_engine
from ddrecon.medium.phase import fit_peaked_phase

wp = pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from ddrecon.medium.fused.peak import fit_kernel  # noqa: E402

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("g", [0.001, 0.3, 0.85, 0.95])
def test_polynomials_agree(g, dtype):
    cosine, found = torch.linspace(-1, 1, 1500, dtype=dtype), []
    for engine in ENGINES:
        use_engine(engine)
        found.append(fit_peaked_phase(cosine, torch.tensor(g, dtype=dtype)))
    exact = 1e-6 if dtype == torch.float32 else 1e-11
    torch.testing.assert_close(*found, rtol=0, atol=exact * float(found[0].abs().max()))


def test_derivatives_are_those_of_the_definition():
    use_engine("warp")
    cosine = torch.linspace(-1, 1, 9, dtype=torch.float64)
    g = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    (bar,) = torch.autograd.grad(fit_peaked_phase(cosine, g).sum(), g)
    assert bool(bar.isfinite()) and float(bar) != 0


@pytest.mark.parametrize("arch", [80, 90])
def test_the_kernel_compiles_for_graphics_cards(arch: int, tmp_path: Path):
    module = fit_kernel(32).module
    wp.compile_aot_module(module, arch=arch, use_ptx=True, module_dir=tmp_path)
    assert list(tmp_path.glob("*.ptx"))
