"""Radiance and opacity from the integrals along rays: by a kernel as by torch's operations."""

import pytest
import torch

pytest.importorskip("warp")

from ddrecon.march.fused.compose import _compose, compose
from ddrecon.march.fused.compose_kernels import compose_kernel, decompose_kernel

pytestmark = pytest.mark.slow


def integrals(bits, colors, channels, beams, has_phases, rays=37):
    """What `compose` takes, at random; a few rays meet nothing, others are opaque."""
    dtype = torch.float64 if bits == 64 else torch.float32
    made = torch.Generator().manual_seed(colors + 2 * channels + 7 * beams)

    def random(*shape):
        return torch.rand(*shape, generator=made, dtype=dtype)

    masses = random(channels, rays) ** 6 * 100
    masses[:, :3] = 0
    factors = [random(rays) if has_phases and b != 1 else None for b in range(beams)]
    fixed = random(channels, 1, 1, 1), random(1, 1, 1, 1), [random(colors) for _ in range(beams)]
    return random((1 + beams) * colors, rays), masses, *fixed, factors


CASES = [
    (colors, channels, beams, has_phases)
    for colors, channels in ((1, 1), (3, 1), (3, 3))
    for beams, has_phases in ((0, False), (1, False), (3, True))
]


@pytest.mark.parametrize(("bits", "near"), [(64, 1e-13), (32, 2e-6)])
@pytest.mark.parametrize("case", CASES)
def test_values_and_derivatives_are_those_of_torch(bits, near, case):
    out, masses, *rest = integrals(bits, *case)
    bar = torch.rand(2 * case[0], out.shape[1], dtype=out.dtype)
    found = []
    for function in (compose, lambda *given: _compose(case[0], *given, given[3])):
        leaves = out.clone().requires_grad_(), masses.clone().requires_grad_()
        value = function(*leaves, *rest)
        found.append((value.detach(), *torch.autograd.grad(value, leaves, bar)))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=near, atol=near)


def test_thin_rays_are_exact():
    masses = torch.logspace(-12, 0, 33, dtype=torch.float64)[None]
    scale = torch.ones(1, dtype=torch.float64)
    opacity = compose(torch.zeros_like(masses), masses, scale, scale, [], [])[1]
    torch.testing.assert_close(opacity, -torch.expm1(-masses[0]), rtol=1e-14, atol=0)


def test_scales_can_be_varied():
    out, masses, scale, scattering, irradiances, _ = integrals(64, 3, 1, 1, False)
    scale = scale.expand(3, 1, 1, 1).clone().requires_grad_()
    light = irradiances[0].clone().requires_grad_()

    def total(scale, light):
        return compose(out, masses, scale, scattering, [light], [None])

    assert torch.autograd.gradcheck(total, (scale, light))


@pytest.mark.parametrize("architecture", [80, 90])
def test_kernels_compile_for_a_gpu(architecture, tmp_path):
    import warp as wp

    for kernel in (compose_kernel(32), decompose_kernel(32)):
        wp.compile_aot_module(
            kernel.module, arch=architecture, use_ptx=True, module_dir=str(tmp_path)
        )
