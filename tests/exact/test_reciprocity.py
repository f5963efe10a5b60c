"""Source and detector may change places: of cells to rounding, of light and camera to the order."""

import math
from dataclasses import replace

import torch
from media import make_scene

from ddrecon.cameras import Camera, look_at
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.grid import Grid
from ddrecon.light.lights import DirectionalLight
from ddrecon.lighting import solve_light
from ddrecon.picture import view_components
from ddrecon.scene import Scene

ONE, OTHER = (-2.0, -2.1, -1.0), (1.2, -0.3, -1.9)
"""Two directions (x, y, z) that are along no axis of the grid."""


def unlike_its_mirror(cells: int) -> torch.Tensor:
    """A smooth density without symmetry, zero at the faces of the unit box."""
    grid = Grid((cells,) * 3, (0.0,) * 3, (1.0,) * 3)
    z, y, x = grid.centers(torch.zeros(1, dtype=torch.float64))
    hump = (torch.sin(math.pi * z) * torch.sin(math.pi * y) * torch.sin(math.pi * x)) ** 2
    return hump * (1 + 0.8 * torch.sin(3 * z + 2 * y) * torch.cos(4 * x))


def power_seen(
    scene: Scene, travel: tuple[float, float, float], towards: tuple[float, float, float]
) -> tuple[float, float]:
    """What leaves along `towards` of light along `travel`, scattered once, and more often."""
    eye = torch.nn.functional.normalize(torch.tensor(towards, dtype=torch.float64), dim=0) * 3 + 0.5
    pose = look_at(eye, torch.full_like(eye, 0.5), eye.new_tensor([0.0, 1.0, 0.0]))
    camera = Camera(pose, (48, 48), 0.9, is_perspective=False)
    lit = replace(scene, lights=[DirectionalLight(eye.new_tensor(travel), eye.new_tensor([1.0]))])
    parts = view_components(solve_light(lit, SolveMemory()), lit, camera)
    return float(parts.single[0].mean()), float(parts.multiple[0].mean())


def asymmetry(cells: int, g: float) -> tuple[float, float]:
    """How much the ways from ONE to OTHER and back differ, of single and of multiple scattering."""
    grid = Grid((cells,) * 3, (0.0,) * 3, (1.0,) * 3)
    scene = make_scene(unlike_its_mirror(cells), grid=grid, sigma_a=(1.0,), sigma_s=(12.0,), g=g)
    forth = power_seen(scene, ONE, OTHER)
    back = power_seen(scene, tuple(-c for c in OTHER), tuple(-c for c in ONE))
    single, multiple = (abs(a - b) / b for a, b in zip(forth, back, strict=True))
    return single, multiple


def test_light_and_camera_may_change_places():
    coarse, fine = (asymmetry(cells, 0.5) for cells in (12, 24))
    assert max(fine) < 0.002 and sum(fine) < 0.45 * sum(coarse), (coarse, fine)
