"""What the page of how sure a run is draws: a volume seen through, and error bars."""

import re

import numpy as np
import pytest
import torch

from ddrecon.report.curve import draw_bars
from ddrecon.report.pictures import BEHIND, OPAQUE, diverge, see_through


def test_what_is_nearer_hides_what_is_behind_it() -> None:
    """By exp(-depth) from the side that the slices are seen from, and nothing hides the empty."""
    density, parts = torch.zeros(2, 3, 4), torch.zeros(2, 3, 4)
    density[:, 1, 2] = 1.0
    parts[1] = 1.0
    left = see_through(density, parts)[:3, :4]
    blue, red = diverge(np.array([-1.0, 1.0]))
    through = np.exp(-OPAQUE / 2)
    # Seen along z, the last slice is in front.
    expected = (1 - through) * red + through * (1 - through) * blue + through**2 * BEHIND
    np.testing.assert_allclose(left[1, 2], expected, rtol=1e-5)
    np.testing.assert_allclose(np.delete(left.reshape(-1, 3), 6, 0), BEHIND, rtol=1e-5)


def test_bars_are_of_one_and_lines_of_two_deviations_on_one_axis() -> None:
    picture = draw_bars([("a", 1.0, 0.5), ("b", 3.0, 0.25)])
    ends = [
        [float(x) for x in pair]
        for pair in re.findall(r'<line x1="([\d.]+)" y1="[\d.]+" x2="([\d.]+)"', picture)
    ]
    middles = [float(x) for x in re.findall(r'<circle cx="([\d.]+)"', picture)]
    unit = (middles[1] - middles[0]) / 2
    lengths = [(right - left) / unit for left, right in ends]
    assert lengths == pytest.approx([2.0, 1.0, 1.0, 0.5], abs=0.01)
    assert [sum(pair) / 2 for pair in ends] == pytest.approx(
        [middles[0]] * 2 + [middles[1]] * 2, abs=0.1
    )
