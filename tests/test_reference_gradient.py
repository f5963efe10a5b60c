"""The derivative by every block of cells against path replay backpropagation (Mitsuba 3) for the
plume of data/plume.

`data/plume/gradient.npz` holds d(mean of the image)/d(density) summed over blocks of 4^3 cells, and
its standard error. That estimator sees no empty cells, so blocks of a mean density below 0.05 are
left out.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from ddrecon.cameras import Camera, look_at
from ddrecon.grid import Grid
from ddrecon.io.volumes.table import read_field
from ddrecon.light.lights import DirectionalLight
from ddrecon.medium.coefficients import Volume
from ddrecon.renderer import render
from ddrecon.scene import Scene, View
from ddrecon.settings import DiffusionSettings, RenderSettings
from ddrecon.variables.values import with_values

PLUME = Path(__file__).parents[1] / "data" / "plume"
SIGMA_T, ALBEDO = 10.0, 0.9


def test_the_plumes_derivative_is_that_of_a_path_tracer() -> None:
    field = read_field(PLUME / "density.npz", "density")
    density = torch.from_numpy(field.values)
    grid = Grid.from_xyz(field.resolution, (-0.5, -0.75, -0.5), (0.5, 0.75, 0.5))
    optics = (torch.tensor([SIGMA_T * part]) for part in (1 - ALBEDO, ALBEDO))
    eye, up = torch.tensor([0.0, 0.3, 3.2]), torch.tensor([0.0, 1.0, 0.0])
    view = View(
        "view", Camera(look_at(eye, torch.zeros(3), up), (64, 64), math.tan(math.radians(28) / 2))
    )
    light = DirectionalLight(torch.tensor([-2.0, -2.0, -1.0]), torch.tensor([math.pi]))
    scene = Scene(
        Volume(grid, density, *optics, torch.tensor(0.0)),
        [light],
        [view],
        RenderSettings(samples_per_pixel=4),
        DiffusionSettings(),
    )
    leaf = density.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(render(with_values(scene, {"density": leaf})).mean(), leaf)
    ours, amount = (
        torch.nn.functional.avg_pool3d(item[None], 4)[0].numpy()
        for item in (64 * gradient, density)
    )
    with np.load(PLUME / "gradient.npz", allow_pickle=False) as archive:
        traced = archive["gradient_blocks4"]
    seen = amount > 0.05
    assert seen.sum() > 500
    assert np.corrcoef(ours[seen], traced[seen])[0, 1] > 0.95
    assert np.linalg.norm(ours[seen] - traced[seen]) < 0.2 * np.linalg.norm(traced[seen])
