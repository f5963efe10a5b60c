"""The paper's experiments at a quarter size: each comes closer to its pictures and the truth."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from ddrecon.io.volumes.table import read_field
from ddrecon.reconstruct.levels import scene_at_level
from ddrecon.reconstruct.loop import optimize
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import value_of

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
CONFIGS = {config.stem: config for config in sorted((ROOT / "configs" / "paper").glob("*.yaml"))}
RECONSTRUCTIONS = [name for name in CONFIGS if name != "fig08"]
"""Fig. 8 is of derivatives, which `tests/variables/test_tangents.py` checks."""
ITERATIONS = 12
CHANGES = [f"optimize.iterations={ITERATIONS}", "diffusion.tolerance=1e-3"]
COARSER = 4
"""How many times larger than the scene's cells and pixels are here."""


def coarse(field: np.ndarray) -> Tensor:
    """Means of `field` [z, y, x] or [z, y, x, 3] over so many cells along each axis."""
    values = torch.from_numpy(field)
    return torch.nn.functional.avg_pool3d(
        values.movedim(-1, 0) if values.ndim == 4 else values[None], COARSER
    )


def true_field(shape: str, name: str = "density") -> Tensor:
    return coarse(read_field(ROOT / "data" / "shapes" / f"{shape}.npz", name).values)


def test_every_experiment_has_a_config_and_a_picture() -> None:
    pictures = re.findall(
        r"\]\((pictures/paper/.*?)\)", (ROOT / "docs" / "experiments.md").read_text()
    )
    assert set(CONFIGS) <= {Path(picture).stem for picture in pictures}
    assert {int(name[3:5]) for name in CONFIGS} == {6, 7, 8, 9, 10, 12, 13, 14}
    assert load_scene(CONFIGS["fig08"]).views
    assert max((ROOT / "docs" / picture).stat().st_size for picture in pictures) < 150_000


FLAT = True
"""A view from the front tells little of depth: only sums along z are asked for."""
FIELDS = {
    "fig13": ("density", "bunny", False),
    "fig06_density": ("density", "knot", FLAT),
    "fig07": ("density", "cloud", FLAT),
    "fig12_single": ("density", "smoke", FLAT),
    "fig10": ("sigma_a", "cloud", False),
}
"""Fields whose truth is known: their names, their shapes, and whether sums are asked for."""


@pytest.mark.parametrize("config", RECONSTRUCTIONS)
def test_a_reconstruction_comes_closer(config: str) -> None:
    """To its pictures, and to the truth where it is known; coefficients are per length."""
    fewer = ["optimize.iterations=4"] if config == "fig10" else []  # each takes seconds
    scene = scene_at_level(load_scene(CONFIGS[config], overrides=[*CHANGES, *fewer]), COARSER)
    result = optimize(scene)
    assert result.rows[-1].loss < 0.5 * result.rows[0].loss
    if config == "fig06_light":
        truth = torch.tensor([3.2, 2.1, 1.2])
        assert (result.scene.lights[0].irradiance - truth).norm() < 0.5 * (1 - truth).norm()
    if config not in FIELDS:
        return
    name, shape, is_flat = FIELDS[config]
    density = scene.volume.density if name != "density" else 1

    def seen(field: Tensor) -> Tensor:
        return (field * density).sum(-3) if is_flat else field * density

    truth = seen(true_field(shape, name))
    before, after = (
        (seen(value) - truth).abs().sum()
        for value in (scene.starts[name], value_of(result.scene, name))
    )
    assert after < 0.9 * before
