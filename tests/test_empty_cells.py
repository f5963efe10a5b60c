"""A picture does not depend on how much of the box is empty."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from media import light_of, make_scene, random_values, tensor
from torch import Tensor
from torch.nn.functional import pad

from ddrecon import lighting
from ddrecon.cameras import Camera, look_at
from ddrecon.grid import Grid
from ddrecon.light.ground import Ground, Plane
from ddrecon.light.lights import PointLight
from ddrecon.picture import render
from ddrecon.scene import Scene

pytestmark = pytest.mark.usefixtures("few_directions")
SHAPE, CELL = (8, 10, 10), 0.1
LIGHTS: dict[str, dict[str, Any]] = {
    "sun": {"travel": (1.0, 0.5, -2.0)},
    "sky": {"directional": None, "ambient": (0.5,)},
    "map": {"directional": None, "is_map": True},
    "glow": {"directional": None, "glows": True},
    "lamp": {"directional": None, "has_lamp": True},
}


def cloud(is_layer: bool) -> Tensor:
    """A smooth field, empty at both ends along z and, unless it `is_layer`, along x and y."""
    up, across = (torch.arange(n, dtype=torch.float64) for n in SHAPE[:2])
    height, hill = (
        (math.pi * (place - 1) / (len(place) - 3)).sin().clamp(min=0) ** 2 for place in (up, across)
    )
    turn = 2 * math.pi / len(across) * across
    side = 1 + 0.5 * turn.sin() * turn[:, None].cos() if is_layer else hill * hill[:, None]
    density = height[:, None, None] * side
    return density.where(density > 1e-9, 0)


def scene_in(density: Tensor, empty: tuple[int, int, int], is_layer: bool, **kind: Any) -> Scene:
    """`density` with so many `empty` cells around it along z, y and x, and twice as many above."""
    ends = [(2 * cells if axis == 0 else cells, cells) for axis, cells in enumerate(empty)][::-1]
    is_map, glows, has_lamp = (kind.pop(name, False) for name in ("is_map", "glows", "has_lamp"))
    ground = kind.pop("ground")
    wide = pad(density, [cells for end in ends for cells in end[::-1]])
    lower = tuple(-CELL * cells for cells in empty)
    upper = tuple(low + CELL * cells for low, cells in zip(lower, wide.shape, strict=True))
    grid = Grid(tuple(wide.shape), lower, upper, periodic=(1, 2) if is_layer else ())
    emission = (0.2 * wide)[None] if glows else None
    middle = tensor(0.5, 0.5, 0.4)
    pose = look_at(middle + tensor(3, 2, 5), middle, tensor(0, 0, 1))
    scene = make_scene(
        wide,
        grid=grid,
        camera=Camera(pose, (8, 8), 0.5, False),
        emission=emission,
        sigma_a=(0.2,),
        sigma_s=(8.0,),
        g=0.6,
        transport_rounds=4,
        degree=3,
        **kind,
    )
    scene.lights += [light_of(random_values(3, 4, 8), up="z", directions=6)] if is_map else []
    scene.lights += [PointLight(tensor(0.5, 0.4, 2.0), tensor(1))] if has_lamp else []
    if ground is None:
        return scene
    return replace(scene, ground=Ground(tensor(ground), Plane(-0.9, 0)))


CASES = [
    (is_layer, light, albedo)
    for is_layer in (True, False)
    for light, albedo in [("sun", None), *((light, 0.8) for light in LIGHTS)]
    if not (is_layer and light == "lamp")
]


@pytest.mark.parametrize(("is_layer", "light", "albedo"), CASES)
def test_a_box_with_more_empty_cells_shows_the_same(
    is_layer: bool, light: str, albedo: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lighting, "MOST_CELLS", 6)
    around = (8, 0, 0) if is_layer else (4, 4, 4)
    images = [
        render(scene_in(cloud(is_layer), empty, is_layer, ground=albedo, **LIGHTS[light]))
        for empty in ((0, 0, 0), around)
    ]
    off = (images[1] - images[0]).norm() / images[0].norm()
    assert float(off) < 1e-3
