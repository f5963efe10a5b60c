"""Phase functions that differ from cell to cell, by what they must do whatever the cells hold."""

from typing import Any

import pytest
import torch
from media import make_scene, random_values
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.lighting import solve_light
from ddrecon.medium.coefficients import scale_medium
from ddrecon.medium.phase import Blend, HenyeyGreenstein, PhaseFunction, Rayleigh, TwoLobe
from ddrecon.medium.phase_peak import SeenPhase
from ddrecon.picture import render
from ddrecon.scene import Scene
from ddrecon.validate.hard import balance_of

SHAPE = (5, 4, 6)
LOBES = torch.tensor([0.8, -0.4], dtype=torch.float64)
HAZE = HenyeyGreenstein(torch.tensor([0.7, 0.6, -0.5], dtype=torch.float64))
AIR = Rayleigh(LOBES[0])
FIELDS: dict[str, PhaseFunction] = {
    "g": HenyeyGreenstein(1.7 * random_values(*SHAPE, seed=3) - 0.8),
    "weight": TwoLobe(LOBES, random_values(*SHAPE, seed=4)),
    "blend by color": Blend(HAZE, AIR, random_values(3, *SHAPE, seed=5)),
}
each_field = pytest.mark.parametrize("phase", FIELDS.values(), ids=FIELDS.keys())


def scene_of(phase: PhaseFunction, **changes: Any) -> Scene:
    """Cross sections are given cell by cell, as coefficients are where a phase function is."""
    sigma_s = torch.tensor([8.0, 6.0, 4.0], dtype=torch.float64).view(3, 1, 1, 1)
    given = {"sigma_s": sigma_s.expand(3, *SHAPE), "ambient": (0.3,)} | changes
    scene = make_scene(random_values(*SHAPE), **given)
    scene.volume.phase = phase
    return scene


@pytest.mark.slow
@pytest.mark.parametrize("rounds", [0, 2])
@pytest.mark.parametrize(
    "phase, is_looked_up",
    [
        *((HenyeyGreenstein(LOBES.new_tensor(g)), g > 0) for g in (0.7, 0.0, -0.5)),
        *((TwoLobe(g, LOBES.new_tensor(0.3)), bool(g.min() > 0)) for g in (LOBES, LOBES.abs())),
        (Blend(HAZE, AIR, LOBES.new_tensor([0.3, 0.8, 0.5])), False),
    ],
    ids=["forward", "isotropic", "backward", "two lobes", "two forward lobes", "blend by color"],
)
def test_the_same_in_every_cell_is_one_number(phase: PhaseFunction, is_looked_up: bool, rounds):
    """To rounding, or as closely as functions are looked up by their number."""
    number = phase.numbers[-1]
    cells = phase.with_cells(number.view(*number.shape, 1, 1, 1).expand(*number.shape, *SHAPE))
    # along an axis: on their way across the grid pairs of cells are interpolated otherwise
    changes = {"transport_rounds": rounds, "travel": (0.0, -1.0, 0.0)}
    one, other = (render(scene_of(each, **changes)) for each in (phase, cells))
    has_pairs = rounds > 0 and float(phase.peak_tail(3, 1, -1).max()) > 0
    tolerance = 1e-3 if is_looked_up or has_pairs else 1e-11
    torch.testing.assert_close(other, one, rtol=tolerance, atol=0)


def differences(phase: PhaseFunction, degree: int) -> tuple[Tensor, Tensor]:
    """How far S of a number at nodes is off that of `phase` itself, [N, R], over 1 or S; and p."""
    depth, cosine = 4 * random_values(7, 1, 9), 2 * random_values(9, seed=1) - 1
    number = phase.numbers[-1]
    cells = SeenPhase(phase.with_cells(number.expand(1, 1, 1)), degree, number.expand(7, 1, 9))
    found, expected = (
        torch.stack([seen.along(depth, cosine), seen.along(0 * depth, cosine)])
        for seen in (cells, SeenPhase(phase, degree))
    )
    return ((found - expected).abs() / expected.clamp(min=1)).unbind()


@pytest.mark.parametrize("degree", [1, 3])
@pytest.mark.parametrize("g", [0.013, 0.333, 0.777, 0.949])
def test_between_the_numbers_of_its_table_s_is_that_of_g(g: float, degree: int):
    apart, without_peak = differences(HenyeyGreenstein(LOBES.new_tensor(g)), degree)
    assert float(apart.max()) < 0.01 and float(without_peak.max()) < 1e-5


@pytest.mark.parametrize("g", [-0.5, 0.0, -1e-9])
def test_without_a_peak_s_is_the_exact_phase_function(g: float):
    apart, without_peak = differences(HenyeyGreenstein(LOBES.new_tensor(g)), 3)
    assert float(torch.maximum(apart, without_peak).max()) < 1e-5


@pytest.mark.parametrize("weight", [0.0, 0.03, 0.41, 1.0])
@pytest.mark.parametrize("lobes", [LOBES, LOBES.new_tensor([0.85, 0.6])], ids=["two", "forward"])
def test_of_two_lobes_s_is_that_of_the_weight(lobes: Tensor, weight: float):
    """Exactly at both ends, and nearly where one lobe alone has a peak."""
    apart, without_peak = differences(TwoLobe(lobes, LOBES.new_tensor(weight)), 3)
    is_exact = weight in (0.0, 1.0)
    assert float(apart.max()) < (1e-10 if is_exact else 1e-3 if lobes[1] < 0 else 0.02)
    assert float(without_peak.max()) < 1e-6


def test_the_same_lobe_twice_is_that_lobe():
    """At any weight, since the peaks of both spread light together."""
    apart, _ = differences(TwoLobe(LOBES.new_tensor([0.8, 0.8]), LOBES.new_tensor(0.3)), 3)
    assert float(apart.max()) < 1e-12


@each_field
@pytest.mark.parametrize("rounds", [0, 2])
def test_a_white_furnace_stays_white(phase: PhaseFunction, rounds: int):
    changes = {"sigma_a": (0.0, 0.0, 0.0), "directional": None, "ambient": (0.7,)}
    image = render(scene_of(phase, transport_rounds=rounds, **changes))
    torch.testing.assert_close(image, torch.full_like(image, 0.7), rtol=1e-10, atol=0)


@each_field
def test_what_is_absorbed_and_leaks_is_what_came_in(phase: PhaseFunction):
    scene = scene_of(phase)
    light = solve_light(scene, SolveMemory()).diffuse
    assert balance_of(scene, light[0]).energy < 1e-12


@each_field
def test_cells_without_scattering_have_no_phase_function(phase: PhaseFunction):
    """Their number changes moments of nothing, and its derivative is zero and finite."""
    density = random_values(*SHAPE)
    density[:, :, 3:] = 0
    number = phase.cells.clone().requires_grad_()
    scene = scene_of(phase.with_cells(number), transport_rounds=1)
    scene.volume.density = density
    medium = scale_medium(scene.volume, 3)
    assert bool(torch.isfinite(medium.peak).all())
    (bar,) = torch.autograd.grad(render(scene).sum(), number)
    assert bool(torch.isfinite(bar).all()) and bool((bar[..., 5] == 0).all())
