"""The plume's derivative by blocks of 4^3 cells, against path replay backpropagation (Mitsuba 3).

That estimator sees no empty cells: blocks of a mean density below 0.05 are left out.
"""

from pathlib import Path

import numpy as np
import torch

from ddrecon.picture import render
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import with_values

ROOT = Path(__file__).parents[2]
CAMERA = "type: perspective, origin: [0, 0.3, 3.2], target: [0, 0, 0], fov: 28"
TRACED = [
    f"volume.density={{file: {ROOT}/data/plume/density.npz}}",
    *("volume.sigma_t=10", "volume.albedo=0.9"),
    *("volume.g=0", "diffusion={}", "optimize=", "render.samples_per_pixel=4"),
    f"views=[{{name: view, camera: {{{CAMERA}, resolution: [64, 64]}}}}]",
]
"""What was traced, beside the config."""


def test_the_plumes_derivative_is_that_of_a_path_tracer() -> None:
    scene = load_scene(ROOT / "configs" / "plume.yaml", overrides=TRACED)
    density = scene.volume.density
    leaf = density.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(render(with_values(scene, {"density": leaf})).mean(), leaf)
    ours, amount = (
        torch.nn.functional.avg_pool3d(item[None], 4)[0].numpy()
        for item in (64 * gradient, density)
    )
    with np.load(ROOT / "data" / "plume" / "gradient.npz", allow_pickle=False) as archive:
        traced = archive["gradient_blocks4"]
    seen = amount > 0.05
    assert seen.sum() > 500
    assert np.corrcoef(ours[seen], traced[seen])[0, 1] > 0.95
    assert np.linalg.norm(ours[seen] - traced[seen]) < 0.2 * np.linalg.norm(traced[seen])
