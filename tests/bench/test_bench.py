"""What a bench measures, and what it makes of its measurements."""

from dataclasses import replace

import pytest
import torch

from ddrecon.bench.measure import Row, Shot, bench_lines, row_of, shoot, with_best
from ddrecon.bench.plume import plume_scene
from ddrecon.reference.trace import Traced
from ddrecon.scene import Scene


@pytest.fixture
def plume() -> Scene:
    return plume_scene(8, 4, torch.float64, torch.device("cpu"))


def test_the_gradient_is_the_slope_of_the_mean_of_the_image(plume: Scene) -> None:
    """Along density itself, by a central difference."""

    def mean(factor: float) -> float:
        volume = replace(plume.volume, density=factor * plume.volume.density)
        return float(shoot(replace(plume, volume=volume)).image.mean())

    along = (shoot(plume).gradient * plume.volume.density).sum()
    assert float(along) == pytest.approx((mean(1.0001) - mean(0.9999)) / 0.0002, rel=1e-4)


def test_the_best_are_those_that_no_other_beats_in_both_time_and_error() -> None:
    known = {"a": (1, 0.3), "b": (2, 0.4), "c": (3, 0.1), "d": (4, 0.1), "e": (5, 0.05)}
    rows = [Row(name, time, time, 1, image_error=error) for name, (time, error) in known.items()]
    assert [row.name for row in with_best(rows) if row.is_best] == ["a", "c", "e"]


def test_nothing_is_made_of_errors_that_the_noise_of_the_truth_hides() -> None:
    image = torch.ones(3, 2, 2)
    truth = Traced(image.numpy(), 0.09)
    known = {"base": (1.02, 1.0), "slower": (1.0, 2.0), "Mitsuba 16 paths a pixel": (1.3, 72.0)}
    shots = {n: Shot(factor * image, None, time, 0.0, 16) for n, (factor, time) in known.items()}
    rows = with_best([row_of(name, [shot], None, truth) for name, shot in shots.items()])
    _, _, *lines, remark = bench_lines(rows)
    assert [line.split(" | ")[7] for line in lines] == ["< 0.03", "< 0.03", "0.286"]
    assert [row.name for row in rows if row.is_best] == ["base"]
    assert "16 paths a pixel take 72 times as long as base" in remark
