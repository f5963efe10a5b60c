"""Half-spaces: one column of cells, 1e9 times as wide as deep, seen from above.

Density grows downwards, from thousandths of an optical depth a cell to hundreds. The closure's
floor is nothing: what is compared is P1 itself, or what transport rounds make of it.
"""

import math
from dataclasses import replace

import torch
from media import make_scene
from torch import Tensor

from ddrecon.cameras import Camera, look_at
from ddrecon.grid import Grid
from ddrecon.picture import render
from ddrecon.scene import Scene, View

VIEWS = (1.0, 0.8, 0.5, 0.25)
"""Cosines mu of the views."""
IRRADIANCE = 3.0


def half_space(
    albedo: float, sun: float, cells: int = 192, rounds: int = 0, g: float = 0.0
) -> Scene:
    """5,000 optical depths below z = 0, lit from above at cosine `sun`, seen at all of `VIEWS`."""
    ratio = 1.06 ** (192 / cells)
    layers = ratio ** torch.arange(cells, dtype=torch.float64)
    density = (5000 / layers.sum() * layers * cells).view(-1, 1, 1)
    grid = Grid((cells, 1, 1), (0.0, -5e8, -5e8), (1.0, 5e8, 5e8))
    light = {"directional": (IRRADIANCE,), "travel": (math.sqrt(1 - sun**2), 0.0, sun)}
    medium = {"sigma_a": (1 - albedo,), "sigma_s": (albedo,), "g": g}
    settings = {"closure": "smooth", "floor": 1e-6, "transport_rounds": rounds, "degree": 5}
    scene = make_scene(density, grid=grid, **light, **medium, **settings)
    return replace(scene, views=[View(f"mu {cosine}", looking_down(cosine)) for cosine in VIEWS])


def looking_down(cosine: float) -> Camera:
    """One pixel on the surface that looks into the medium at `cosine` with the normal."""
    target = torch.tensor([0.0, math.sqrt(1 - cosine**2), cosine], dtype=torch.float64)
    pose = look_at(torch.zeros_like(target), target, target.new_tensor([1.0, 0.0, 0.0]))
    return Camera(pose, (1, 1), 1e-6, is_perspective=False)


def seen(scene: Scene) -> list[float]:
    """The radiance that each view of `scene` sees."""
    image: Tensor = render(scene)
    return image[:, 0, 0, 0].tolist()


def relative_rms(found: list[float], wanted: list[float]) -> float:
    """The relative root mean square error."""
    return math.dist(found, wanted) / math.hypot(*wanted)
