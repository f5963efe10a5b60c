"""Beams in pairs: what a light along an axis brings into a column is all found again."""

import math
from typing import Any

import pytest
import torch
from media import make_scene

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.grid import Grid
from ddrecon.light.moments import beam_moments, weigh
from ddrecon.light.pairs import follow_pair
from ddrecon.lighting import solve_light
from ddrecon.medium.coefficients import scale_medium
from ddrecon.medium.remaining import (
    backward_fraction,
    remaining_moments,
    unturned_moments,
)
from ddrecon.scene import Scene
from ddrecon.validate.hard import balance_of

IRRADIANCE = 3.0


def in_unit_box(density: torch.Tensor, travel=(0.0, 0.0, 2.0), **changes: Any) -> Scene:
    grid = Grid(tuple(density.shape), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    medium = {"sigma_a": (0.5,), "sigma_s": (6.0,), "directional": (IRRADIANCE,)}
    return make_scene(density, grid=grid, travel=travel, **medium, **changes)


def test_energy_is_kept_where_the_backward_peak_differs_from_cell_to_cell() -> None:
    """What F and G lose in a cell is what scatters there and is absorbed, and the rest leaves."""
    torch.manual_seed(1)
    density, g = torch.rand(2, 9, 1, 1, dtype=torch.float64)
    density[4] = 0
    scene = in_unit_box(density)
    scene.volume.g = 0.6 - 1.5 * g
    medium = scale_medium(scene.volume, 3)
    pair = follow_pair(medium, scene.lights[0])
    # what a cell takes, kappa_t of both less what it turns, and what it hands on to its neighbors
    turned = backward_fraction(medium) * medium.scattering.value
    beams = 4 * math.pi / 9 * (pair.along + pair.against)
    taken = ((medium.extinction.value - turned) * beams).flatten()
    # a slab of layers, each by its own closed form, added up from the far end
    passed, reflected = 1.0, 0.0
    beta = (turned / medium.extinction.value).nan_to_num().flatten()
    depth = medium.extinction.value.flatten() / 9
    for k in reversed(range(9)):
        rate = math.sqrt(1 - float(beta[k]) ** 2)
        back, through = float(beta[k]) / (1 + rate), math.exp(-rate * float(depth[k]))
        norm = 1 / (1 - (back * through) ** 2)
        lets, turns = (1 - back**2) * through * norm, back * (1 - through**2) * norm
        again = 1 / (1 - turns * reflected)
        passed, reflected = lets * again * passed, turns + lets**2 * reflected * again
    assert float(taken.sum()) == pytest.approx(IRRADIANCE * (1 - passed - reflected), rel=1e-12)


@pytest.mark.parametrize("g", [-0.8, -0.4])
def test_energy_that_enters_leaves_is_absorbed_or_scatters(g: float) -> None:
    """E8.11's beams leave with F and G at the ends; the rest, the source of E2.4, is balanced."""
    density = 0.2 + torch.rand(9, 1, 1, dtype=torch.float64)
    scene = in_unit_box(density, g=g, transport_rounds=1, degree=3)
    medium = scale_medium(scene.volume, 3)
    pair = follow_pair(medium, scene.lights[0])
    beams = 4 * math.pi * (pair.along + pair.against)
    volume = medium.grid.extent[0] / 9
    received = (medium.absorption.value * beams).sum() * volume
    scattered = 4 * math.pi * volume * (medium.scattering.value * pair.source(medium)[0]).sum()
    # what leaves, by the closed form of E8.11 for all the depth
    beta = float(backward_fraction(medium)) * 6.0 / 6.5
    rate, depth = math.sqrt(1 - beta**2), 6.5 * float(density.mean())
    turned, passed = beta / (1 + rate), math.exp(-rate * depth)
    leaves = (1 - turned**2) * passed + turned * (1 - passed**2)
    leaves = IRRADIANCE * leaves / (1 - (turned * passed) ** 2)
    assert float(received + scattered) + leaves == pytest.approx(IRRADIANCE, rel=1e-12)
    memory = SolveMemory()
    solve_light(scene, memory)
    assert balance_of(scene, memory.last["forward", 0]).energy < 1e-11


@pytest.mark.parametrize("varied", ["g", "sigma_s"])
def test_an_empty_cell_is_the_limit_of_thin_ones(varied: str) -> None:
    """So are derivatives there: what cells that are not there yet would turn back is known."""
    torch.manual_seed(2)
    density, share = torch.rand(2, 5, 4, 3, dtype=torch.float64)
    density[1:3] = 0
    scene = in_unit_box(density, g=-0.7, travel=(0.5, -0.3, 2.0))
    volume = scene.volume
    if varied == "g":
        volume.g = -0.9 * share
    else:
        volume.sigma_s = 6 * share[None]

    def pair_at(least: float) -> tuple[torch.Tensor, torch.Tensor]:
        volume.density = density.clamp(min=least).requires_grad_()
        pair = follow_pair(scale_medium(volume, 3), scene.lights[0])
        both = torch.stack([pair.along, pair.against])
        weights = torch.arange(1.0, both.numel() + 1, dtype=torch.float64).view_as(both).cos()
        return both.detach(), torch.autograd.grad((weights * both).sum(), volume.density)[0]

    for empty, thin in zip(pair_at(0.0), pair_at(1e-9), strict=True):
        torch.testing.assert_close(empty, thin, rtol=1e-7, atol=1e-7)


def test_what_a_beam_scatters_is_what_turns_back_and_the_rest() -> None:
    """In every moment: the backward peak is light that goes against the beam (E8.11)."""
    medium = scale_medium(in_unit_box(torch.ones(2, 1, 1).double(), g=-0.7).volume, 5)
    way, mean = torch.tensor([0.48, -0.6, 0.64]).double(), torch.ones(1, 2, 1, 1).double()
    back = backward_fraction(medium) / (1 - medium.forward_fraction)
    against = back * beam_moments(mean, -way, 5)
    rest, whole = (
        weigh(beam_moments(mean, way, 5), moments(medium))
        for moments in (unturned_moments, remaining_moments)
    )
    torch.testing.assert_close(rest + against, whole, rtol=1e-12, atol=1e-12)
