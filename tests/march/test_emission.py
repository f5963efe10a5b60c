"""The fields of an emission, packed for interpolation and unpacked again."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from media import make_camera, make_scene, random_values
from torch import Tensor

from ddrecon.cameras import cast_rays
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.light.lights import PointLight
from ddrecon.march.emission import Sampled, pack_channels
from ddrecon.renderer import _emission, solve_light

SHAPE = (3, 4, 2)
VARYING = random_values(3, *SHAPE, seed=1)


def fields_of(sampled: Sampled) -> list[Tensor]:
    peak = [] if sampled.peak is None else [sampled.peak]
    return [sampled.extinction, sampled.diffuse, *sampled.masses, sampled.scattering, *peak]


@pytest.mark.parametrize("g", [0.0, 0.5], ids=["no peak", "a peak"])
@pytest.mark.parametrize("changes", [{}, {"sigma_s": VARYING}, {"sigma_a": VARYING}])
def test_what_is_unpacked_is_what_was_packed(changes: dict[str, Any], g: float):
    """Values in all cells, as if these were one node of as many rays, get their own names again."""
    scene = make_scene(random_values(*SHAPE), g=g, **changes)
    scene.lights.append(PointLight(torch.ones(3).double(), torch.ones(3).double()))
    emission = _emission(solve_light(scene, SolveMemory()), cast_rays(make_camera()))
    cells = Sampled.in_cells(emission)
    unpacked = cells.unpack(torch.cat(cells.fields()).flatten(1)[None])
    for packed, field in zip(fields_of(cells), fields_of(unpacked), strict=True):
        assert torch.equal(packed.flatten(1), field.squeeze(0))
    channels = pack_channels(emission)
    masses = channels.values[channels.third_order.channels]
    assert torch.equal(masses, torch.cat(cells.masses))
