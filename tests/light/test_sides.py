"""Beams that enter through sides: about what falls on a thick box is what its cells take."""

import pytest
import torch

from ddrecon.grid import Grid
from ddrecon.light.beam import attenuate
from ddrecon.medium.coefficients import Volume, scale_medium

SHAPE = 12, 10, 11
SPACING = 0.1, 0.12, 0.08
GRID = Grid(SHAPE, (0.0,) * 3, tuple(n * h for n, h in zip(SHAPE, SPACING, strict=True)))


def taken(depth: float, direction: torch.Tensor) -> float:
    """The power that cells of so many optical depths take of a beam, over what falls on the box."""
    density = torch.full(SHAPE, depth / 0.1, dtype=torch.float64)
    absorbing, scattering, g = torch.tensor([[0.3], [0.7], [0.0]], dtype=torch.float64)
    medium = scale_medium(Volume(GRID, density, absorbing, scattering, g[0]))
    weights = torch.ones(1, 1, 1, dtype=torch.float64)
    tau = attenuate(medium, direction[None], weights).mean
    absorbed = float((medium.extinction.value * tau).sum()) * torch.tensor(SPACING).prod()
    z, y, x = GRID.extent
    faces = torch.tensor([y * x, z * x, z * y], dtype=torch.float64)
    return float(absorbed / (direction.abs() * faces).sum())


@pytest.mark.parametrize("depth", [3.0, 10.0, 100.0])
@pytest.mark.parametrize(
    "direction", [(1.0, 0.9, 0.5), (-0.3, 0.2, -1.0), (0.02, 1.0, 0.0), (-1.0, 1.0, 1.0)]
)
def test_thick_cells_take_what_falls_on_the_box(
    depth: float, direction: tuple[float, float, float]
):
    unit = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float64), dim=0)
    assert taken(depth, unit) == pytest.approx(1.0, abs=0.17)
