"""Light scattered once under an environment map, against Mitsuba 3's volumetric path tracing where
that is installed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from media import make_camera, make_scene
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.lights import EnvironmentLight
from ddrecon.renderer import render
from ddrecon.settings import RenderSettings

CELLS, SIGMA_A, SIGMA_S, FOV, SIZE, ROTATION = 24, 1.0, 9.0, 28.0, 24, 30.0
EYE = (0.0, 0.3, 3.2)


def sky_map() -> Tensor:
    """A blue sky over dark ground [3, 16, 32], with a sun that sends as much as all the rest."""
    height = torch.linspace(1, -1, 16, dtype=torch.float64).view(1, 16, 1)
    sky = torch.tensor([0.4, 0.6, 1.0], dtype=torch.float64).view(3, 1, 1) * torch.sigmoid(
        8 * height
    )
    radiance = sky.expand(3, 16, 32).clone()
    radiance[:, 4, 5] += torch.tensor([220.0, 180.0, 120.0])
    return radiance


def ball() -> Tensor:
    axes = Grid((CELLS,) * 3, (-0.5,) * 3, (0.5,) * 3).centers(torch.zeros(1, dtype=torch.float64))
    radius = sum(axis**2 for axis in axes).sqrt()
    return torch.sigmoid((0.38 - radius) / 0.03)


def traced_once(mitsuba: Any, density: Tensor, radiance: Tensor, g: float) -> Tensor:
    """The image [3, h, w] by paths that scatter at most once, each pixel averaged over its area."""
    transform = mitsuba.ScalarTransform4f
    medium = {
        "type": "heterogeneous",
        "scale": SIGMA_A + SIGMA_S,
        "albedo": {"type": "constvolume", "value": SIGMA_S / (SIGMA_A + SIGMA_S)},
        "sigma_t": {
            "type": "gridvolume",
            "grid": mitsuba.VolumeGrid(density.float().numpy()[..., None]),
            "to_world": transform().translate([-0.5, -0.5, -0.5]),
            "raw": True,
        },
        "phase": {"type": "hg", "g": g},
    }
    film = {
        "type": "hdrfilm",
        "width": SIZE,
        "height": SIZE,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
    }
    view = transform().look_at(origin=list(EYE), target=[0, 0, 0], up=[0, 1, 0])
    sampler = {"type": "independent", "sample_count": 512}
    bitmap = mitsuba.Bitmap(np.ascontiguousarray(radiance.permute(1, 2, 0).float().numpy()))
    scene = {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": 2},
        "sensor": {
            "type": "perspective",
            "fov": FOV,
            "fov_axis": "x",
            "to_world": view,
            "film": film,
            "sampler": sampler,
        },
        "sky": {
            "type": "envmap",
            "bitmap": bitmap,
            "to_world": transform().rotate([0, 1, 0], ROTATION),
        },
        "cube": {
            "type": "cube",
            "to_world": transform().scale(0.5),
            "bsdf": {"type": "null"},
            "interior": medium,
        },
    }
    return (
        torch.from_numpy(np.array(mitsuba.render(mitsuba.load_dict(scene), seed=1)))
        .permute(2, 0, 1)
        .double()
    )


@pytest.mark.parametrize("g", [0.0, 0.6])
def test_light_scattered_once_is_within_3_percent_of_path_tracing(g: float):
    mitsuba = pytest.importorskip(
        "mitsuba", reason="the reference needs Mitsuba 3 (the extra `reference`)"
    )
    mitsuba.set_variant("scalar_rgb")
    density, radiance = ball(), sky_map()
    camera = make_camera(eye=EYE, size=(SIZE, SIZE), half_width=float(np.tan(np.radians(FOV / 2))))
    scene = make_scene(
        density,
        grid=Grid((CELLS,) * 3, (-0.5,) * 3, (0.5,) * 3),
        sigma_a=(SIGMA_A,),
        sigma_s=(SIGMA_S,),
        g=g,
        camera=camera,
        model="none",
    )
    light = EnvironmentLight(radiance, radiance.new_tensor(1.0), radiance.new_tensor(ROTATION))
    scene = replace(scene, lights=[light], render=RenderSettings(samples_per_pixel=4))
    expected, found = traced_once(mitsuba, density, radiance, g), render(scene)[0]
    assert float((found - expected).norm() / expected.norm()) < 0.03
