"""The fused kernels of E2.3 towards a camera compute what PyTorch's operations compute."""

import itertools
from pathlib import Path

import pytest
import torch
from graphics_cards import assert_compiles
from media import box_grid, half_empty, random_values
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.engine import use_engine
from ddrecon.light.moments import radiance_along, weigh
from ddrecon.light.outgoing import scatter_towards
from ddrecon.medium.coefficients import Volume, scale_medium

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from ddrecon.kernels.cell_function import RowFunction
from ddrecon.light.fused.outgoing import GIVEN, HEADER, VIEW, scatter_fused

pytestmark = pytest.mark.slow


def make_light(shape: tuple[int, int, int], colors: int, degree: int, dtype: torch.dtype) -> Tensor:
    """phi that is dark in parts, and so directed that E2.3 is of either sign."""
    light = random_values((degree + 1) ** 2, colors, *shape, seed=11) * half_empty(*shape, seed=2)
    light[1:4] = 6 / 3**0.5 * (light[1:4] - 0.1)
    light[4:] -= 0.5
    return light.to(dtype).requires_grad_()


def radiance_and_bars(
    engine: str,
    shape: tuple[int, int, int],
    colors: int,
    view: tuple[bool, bool],
    g: float,
    dtype: torch.dtype,
) -> list[Tensor]:
    """E2.3 and its cotangents; `view`: light has a flux, and the camera is inside the box."""
    use_engine(engine)
    has_flux, is_eye = view
    light = make_light(shape, colors, int(has_flux), dtype)
    point = torch.tensor([0.1, 0.2, 0.3] if is_eye else [0.6, 0.0, 0.8], dtype=dtype)
    cosine = torch.tensor(g, dtype=dtype).requires_grad_()
    rays = Rays(point[None], -point.requires_grad_()[None], point if is_eye else None)
    sigma = torch.ones(1, dtype=dtype)
    volume = Volume(box_grid(shape), half_empty(*shape, dtype=dtype), sigma, sigma, cosine)
    radiance = scatter_towards(scale_medium(volume), light, rays)
    # As a view of what has its colors last.
    bar = random_values(*radiance.shape[1:], len(radiance), seed=1).to(dtype).movedim(-1, 0)
    leaves = [light, cosine, *([point] if has_flux else [])]
    return [radiance, *torch.autograd.grad(radiance, leaves, bar)]


@pytest.mark.parametrize("shape", [(5, 7, 19), (1, 4, 3), (1, 1, 1)], ids=str)
@pytest.mark.parametrize("g", [0.0, 0.4, -0.4])
def test_radiance_and_cotangents_are_those_of_torch(shape: tuple[int, int, int], g: float):
    views = itertools.product((False, True), repeat=2)
    cases = [(*case, torch.float64, 1e-12) for case in itertools.product(views, (1, 3))]
    for view, colors, dtype, error in (*cases, (*cases[-1][:2], torch.float32, 1e-5)):
        known, fused = (
            radiance_and_bars(engine, shape, colors, view, g, dtype) for engine in ("torch", "warp")
        )
        for value, expected in zip(fused, known, strict=True):
            # Sums over cells cancel in part.
            size = max(float(expected.detach().norm()), 1e-3) * (1 if value.ndim > 1 else 30)
            torch.testing.assert_close(value, expected, rtol=0, atol=error * size)


def test_radiance_is_bent_somewhere():
    """What the other test compares has all three parts of the bend."""
    use_engine("warp")
    radiance = radiance_and_bars("warp", (5, 7, 19), 3, (True, True), 0.4, torch.float64)[0]
    assert bool((radiance == 0).any()) and bool((radiance > 1e-2).any())
    assert bool(((radiance > 0) & (radiance < 1e-2)).any())


@pytest.mark.parametrize("has_more", [False, True])
@pytest.mark.parametrize("degree", [1, 2, 3, 5, 7])
def test_light_of_any_degree(degree: int, has_more: bool):
    """Towards an eye inside the box, and with radiance besides, bent as a whole."""
    shape, dtype = (3, 4, 17), torch.float64
    leaves = {"light": make_light(shape, 3, degree, dtype)}
    if has_more:
        leaves["more"] = random_values(3, *shape, seed=6)
    leaves["factors"] = random_values(degree + 1, 3, 1, 1, 1, seed=7)
    leaves["eye"] = torch.tensor([0.1, 0.2, 0.3], dtype=dtype)
    for leaf in leaves.values():
        leaf.requires_grad_()
    rays = Rays(leaves["eye"][None], -leaves["eye"][None], leaves["eye"])
    light, grid, more = leaves["light"], box_grid(shape), leaves.get("more")
    fused = scatter_fused(grid, light, leaves["factors"], rays, more)
    known = radiance_along(weigh(light, leaves["factors"]), rays.towards_eye(grid), more)
    assert has_more or bool((known == 0).any())
    torch.testing.assert_close(fused, known, rtol=0, atol=1e-12)
    bars = [
        torch.autograd.grad(light, [*leaves.values()], 1 + known.detach())
        for light in (fused, known)
    ]
    for one, other in zip(*bars, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-11 * float(other.abs().max()))


def test_kernels_compile_for_graphics_cards(tmp_path: Path):
    function = RowFunction(HEADER, "Outgoing<3, 1, 1>", ((3, 1, 1, 1),), 1, VIEW, GIVEN)
    assert_compiles([function.kernel("tangents", 17, 32)], tmp_path)
