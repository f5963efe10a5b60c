"""Motion between fields: that of a shifted blob is the shift, and what is carried has moved."""

import pytest
import torch
from torch import Tensor

from ddrecon.numerics.flow import carry, find_flow

SHAPE = (20, 28, 24)


def blob(z: float, y: float, x: float) -> Tensor:
    lines = (torch.arange(n).double() - n / 2 - s for n, s in zip(SHAPE, (z, y, x), strict=True))
    zs, ys, xs = torch.meshgrid(*lines, indexing="ij")
    return 3 * torch.exp(-(zs**2 + ys**2 + xs**2) / 18)


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (0.4, -0.3, 0.2), (1.0, 2.5, -1.5)])
def test_the_flow_of_a_moved_blob_is_its_motion(shift: tuple[float, float, float]) -> None:
    before, after = blob(0, 0, 0), blob(*shift)
    flow = find_flow(before, after)
    weight = after / after.sum()
    mean = (flow * weight).sum((1, 2, 3))
    assert (mean - mean.new_tensor(shift)).norm() <= 0.03 + 0.05 * mean.norm()
    left = (carry(before, flow) - after).norm() / after.norm()
    assert left < 0.05


def test_a_motion_of_whole_cells_shifts() -> None:
    field, flow = torch.rand(2, *SHAPE).double(), torch.zeros(3, *SHAPE).double()
    flow[1], flow[2] = 2, -1
    expected = field.roll((2, -1), (2, 3))
    carried = carry(field, flow)
    inner = (slice(None), slice(None), slice(2, None), slice(0, -1))
    torch.testing.assert_close(carried[inner], expected[inner], rtol=0, atol=1e-12)
    assert carried.max() <= field.max() and carried.min() >= field.min()
