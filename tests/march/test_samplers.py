"""In which slices view rays cross a volume."""

from dataclasses import replace

import torch
from media import make_camera

from ddrecon.cameras import cast_rays
from ddrecon.grid import Grid
from ddrecon.march.box import cross_box
from ddrecon.march.samplers import choose_sampling


def test_rounding_does_not_choose_between_axes() -> None:
    """Seen at 45 degrees two axes are crossed equally fast: slices lie across the first of them."""
    grid = Grid((6, 6, 6), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    rays = cast_rays(make_camera(eye=(2.5, 0.0, 2.5), half_width=0.2))
    for _ in range(8):
        noise = 1 + 1e-15 * torch.randn(3, dtype=torch.float64)
        bundle = replace(rays, direction=rays.direction * noise)
        assert choose_sampling(grid, bundle, cross_box(grid, bundle)).axis == 0
