"""A contestant leaves the scene that all share as it was, whether it can be solved or not."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from ddrecon.bench.measure import blocks_of, measure, shoot
from ddrecon.bench.plume import plume_scene
from ddrecon.errors import SolveError
from ddrecon.scene import Scene


@pytest.fixture
def plume() -> Scene:
    return plume_scene(8, 4, torch.float64, torch.device("cpu"))


def test_the_gradient_is_the_slope_of_the_mean_of_the_image(plume: Scene) -> None:
    """Along density itself, by a central difference."""
    blocks = blocks_of(plume)
    shot = shoot(plume, blocks)

    def mean(factor: float) -> float:
        volume = replace(plume.volume, density=factor * plume.volume.density)
        return float(shoot(replace(plume, volume=volume), blocks).image.mean())

    slope = (mean(1.0001) - mean(0.9999)) / 0.0002
    assert float(shot.by_amount.sum()) == pytest.approx(slope, rel=1e-4)


def test_one_that_cannot_be_solved_leaves_the_density_without_gradients(plume: Scene) -> None:
    (light,) = plume.lights
    unsolvable = replace(plume, lights=[replace(light, irradiance=math.inf * light.irradiance)])
    before = plume.volume.density
    with pytest.raises(SolveError):
        shoot(unsolvable, blocks_of(plume))
    timings = measure(
        {
            "unsolvable": lambda: shoot(unsolvable, blocks_of(plume)),
            "plume": lambda: shoot(plume, blocks_of(plume)),
        },
        2,
        lambda items, what: items,
    )
    assert list(timings) == ["plume"] and len(timings["plume"].shots) == 2
    assert plume.volume.density is before and not before.requires_grad
    assert math.isfinite(float(timings["plume"].shots[0].gradient.sum()))
