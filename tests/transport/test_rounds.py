"""Transport rounds: where they lead, how fast, in thick cells, and what derivatives cost."""

from dataclasses import replace
from itertools import pairwise, product

import pytest
import torch
from media import count_kept, make_scene

from ddrecon.bench import ball as hard_ball
from ddrecon.bench import layer
from ddrecon.diffusion.cells import average_cells
from ddrecon.diffusion.closures import Closure
from ddrecon.diffusion.conservative import DiffusionProblem
from ddrecon.diffusion.implicit import SolveMemory, SolverWithMemory
from ddrecon.diffusion.solve import solve_by_multigrid
from ddrecon.engine import use_engine
from ddrecon.grid import Grid
from ddrecon.light.moments import cut
from ddrecon.light.reduced import receive_light
from ddrecon.lighting import solve_light
from ddrecon.medium.coefficients import scale_medium
from ddrecon.picture import render
from ddrecon.transport.rounds import run_rounds
from ddrecon.transport.sweep import emitted_light, steep_gradient, sweep

CUBES = (1.0, 1.0, 1.0)


@pytest.fixture(autouse=True)
def whatever_is_fastest(same_engine):
    """What holds of rounds holds with either engine, to rounding (`test_fused_sweep.py`)."""
    use_engine("auto")


def ball(cells=12, radius=0.35):
    """A soft ball of density 1 in a box of unit sides (see `make_scene`)."""
    x = (torch.arange(cells, dtype=torch.float64) + 0.5) / cells - 0.5
    distance = (x[:, None, None] ** 2 + x[None, :, None] ** 2 + x**2).sqrt()
    return ((radius - distance) * cells / 3 + 0.5).clamp(0, 1)


def light_after(scene, rounds):
    """L0 after so many rounds."""
    scene = replace(scene, diffusion=replace(scene.diffusion, transport_rounds=rounds))
    return solve_light(scene, SolveMemory()).diffuse[0]


def swept_of(medium, scatters, directions):
    """The moments of the radiance of what `scatters`."""
    emitted = emitted_light(medium, cut(scatters))
    rise = steep_gradient(medium, scatters[0], directions)
    return sweep(medium.grid, medium.extinction.value, emitted, rise, directions)


def test_rounds_lead_to_where_sweeps_change_nothing_and_each_shrinks_what_is_left():
    scene = make_scene(ball(), sigma_a=(0.0,), sigma_s=(3.0,), directional=(3.0,), tolerance=1e-10)
    medium = average_cells(scale_medium(scene.volume))
    source = receive_light(medium, scene.lights, 0).source
    last = light_after(scene, 12)
    light = last + source[0]
    swept = swept_of(medium, light[None], 44)[0]
    torch.testing.assert_close(swept, last, rtol=0, atol=3e-5 * float(last.max()))
    left = [float((light_after(scene, rounds) - last).norm()) for rounds in range(4)]
    assert all(after < 0.4 * before for before, after in pairwise(left)), left


@pytest.mark.slow
@pytest.mark.parametrize(("g", "engine"), [(0.0, "warp"), (0.6, "torch"), (0.85, "warp")])
def test_a_tolerance_ends_rounds_where_one_changes_light_by_less(g, engine):
    """And light is as near to its limit as that says, in fewer rounds the larger it is."""
    scene = make_scene(ball(8), sigma_a=(1.0,), sigma_s=(20.0,), g=g, directional=(3.0,))
    records, found = [], []
    use_engine(engine)
    limit = light_after(scene, 16)
    for tolerance in (1e-1, 1e-3):
        settings = replace(scene.diffusion, transport_rounds=16, transport_tolerance=tolerance)
        memory = SolveMemory()
        found.append(solve_light(replace(scene, diffusion=settings), memory).diffuse[0])
        records.append(next(one for one in memory.records if one.kind == "rounds"))
    for record, tolerance, light in zip(records, (1e-1, 1e-3), found, strict=True):
        assert record.residual < tolerance
        assert float((light - limit).norm() / limit.norm()) < 3 * tolerance
    assert 1 <= records[0].iterations < records[1].iterations < 16


def left_of_noise(density, spacing, depth, g, degree, rounds):
    """Sizes of what so many rounds leave of noise, which holds all waves, without any source.

    `depth` is that of cells of density 1 along their shortest side.
    """
    cells, random = density.shape, torch.Generator().manual_seed(7)
    z, y, x = (n * step for n, step in zip(cells, spacing, strict=True))
    sigma = depth / min(spacing)
    scene = make_scene(
        density,
        sigma_a=(1e-4 * sigma,),
        sigma_s=((1 - 1e-4) * sigma,),
        g=g,
        grid=Grid((cells[0], cells[1], cells[2]), (0.0, 0.0, 0.0), (z, y, x)),
    )
    medium = scale_medium(scene.volume, degree)
    known = (degree + 1) ** 2 if g else 1
    noise = torch.randn(known, 1, *cells, generator=random, dtype=torch.float64)
    dark, high = cut(0 * noise)
    problem = DiffusionProblem(
        medium, Closure("geometric", medium.grid), dark, noise.new_zeros(1, 1, 1, 1), g != 0
    )
    solve = SolverWithMemory(solve_by_multigrid, 1e-8, SolveMemory(is_warm=False))
    return [float(run_rounds(problem, high, noise, solve, n, degree).norm()) for n in rounds]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("g", "degree", "thickness"),
    [(-0.8, 3, 0.1), (0.6, 5, 6.0), (0.95, 5, 1.5), (0.95, 7, 6.0)],
)
def test_rounds_forget_where_they_began(g, degree, thickness):
    """In a box full of medium, where diffusion passes few waves on."""
    full = torch.ones(10, 10, 10, dtype=torch.float64)
    (begun, left) = left_of_noise(full, CUBES, thickness, g, degree, (0, 16))
    assert left < 2e-3 * begun


LIGHT = [(0.0, 3, 0.5), (-0.8, 3, 6.0), (0.85, 5, 2.0)]
SPACINGS = [CUBES, (1.0, 1.0, 20.0), (20.0, 1.0, 1.0), (1.0, 5.0, 0.2)]
VOLUMES = [torch.ones, hard_ball, layer]


@pytest.mark.parametrize(("shape", "volume"), [*product(range(4), range(3))])
def test_what_is_left_shrinks_in_hard_volumes(shape, volume):
    """Up to faces and corners, where density jumps by 1e6, and in flat and long cells.

    Each two of a volume, a spacing and a phase function meet.
    """
    density, spacing, (g, degree, thickness) = (
        VOLUMES[volume],
        SPACINGS[shape],
        LIGHT[(shape + volume) % 3],
    )
    left = left_of_noise(density((6, 5, 7)).double(), spacing, thickness, g, degree, (0, 6, 12, 18))
    assert all(after < 0.95 * before for before, after in pairwise(left)), left


@pytest.mark.parametrize("g", [1e-9, -1e-9])
def test_light_without_direction_is_the_limit_of_light_with(g):
    plain, nearly = (
        make_scene(ball(8), g=value, directional=(3.0,), transport_rounds=2, tolerance=1e-11)
        for value in (0.0, g)
    )
    torch.testing.assert_close(render(nearly), render(plain), rtol=1e-6, atol=0)


def test_memory_does_not_grow_with_directions():
    use_engine("torch")
    scene = make_scene(ball(10).requires_grad_(), directional=(3.0,))
    medium, source = scale_medium(scene.volume), torch.ones(1, 3, 10, 10, 10).double()
    few, many = (count_kept(lambda n=n: swept_of(medium, source, n).sum(), 1000) for n in (44, 96))
    assert few == many
