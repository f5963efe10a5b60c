"""What a bench makes of its measurements: the front of time and error, and what each row is
compared with.
"""

from __future__ import annotations

import math

import pytest
import torch

from ddrecon.bench.measure import Shot, Timing, block_sums
from ddrecon.bench.path_tracing import Truth
from ddrecon.bench.report import Row, cells, rows_of, with_best
from ddrecon.bench.run import against_path_tracing
from ddrecon.reference.trace import Traced


def row(name: str, seconds: float, error: float) -> Row:
    return Row(name, seconds, seconds, 1, image_error=error)


def test_the_best_are_those_that_no_other_beats_in_both_time_and_error() -> None:
    rows = [
        row("a", 1, 0.3),
        row("b", 2, 0.4),
        row("c", 3, 0.1),
        row("d", 4, 0.1),
        row("e", 5, 0.05),
    ]
    assert [item.name for item in with_best(rows) if item.is_best] == ["a", "c", "e"]


def test_nothing_is_made_of_errors_that_the_noise_of_the_truth_hides() -> None:
    image = torch.ones(3, 2, 2)
    ours, slower, traced = (
        Timing([Shot(factor * image, image, image, seconds, 0.0, 16)])
        for factor, seconds in ((1.02, 1.0), (1.0, 2.0), (1.3, 72.0))
    )
    timings = {"base": ours, "slower": slower, "Mitsuba 16 paths a pixel": traced}
    rows = rows_of(timings, {}, Truth(Traced(image.numpy(), 0.09)))
    assert [line[7] for line in cells(rows)] == ["< 0.03", "< 0.03", "0.286"]
    assert [row.name for row in rows if row.is_best] == ["base"]
    (told,) = against_path_tracing(rows)
    assert "64 paths" in told and "16 paths a pixel take 72 times as long" in told


def test_rows_hold_medians_and_errors_of_what_can_be_compared() -> None:
    image, gradient = torch.ones(3, 2, 2), torch.arange(8.0).view(2, 2, 2)
    shots = [
        Shot(1.1 * image, 2 * gradient, gradient, seconds, 2 * seconds, 7)
        for seconds in (5.0, 1.0, 2.0)
    ]
    exact = {"ours": Shot(image, gradient, gradient, 9.0, 9.0, 9)}
    truth = Truth(Traced(image.numpy(), 0.0), Traced(-gradient.numpy(), 0.0))
    ours, theirs = rows_of({"ours": Timing(shots), "theirs": Timing(shots[:1])}, exact, truth)
    assert (ours.image_seconds, ours.both_seconds, ours.iterations) == (2.0, 6.0, 7)
    assert ours.image_numerical == pytest.approx(0.1) and ours.gradient_numerical == pytest.approx(
        1.0
    )
    assert theirs.image_numerical is None and theirs.image_error == pytest.approx(0.1)
    assert ours.gradient_correlation == pytest.approx(-1.0)


@pytest.mark.parametrize("size", [(8, 4, 12), (4, 4, 4), (9, 6, 7)])
def test_sums_over_blocks_keep_the_total_of_what_is_even(size: tuple[int, int, int]) -> None:
    assert float(block_sums(torch.ones(size), (2, 1, 3)).sum()) == pytest.approx(
        math.prod(size), rel=1e-6
    )
