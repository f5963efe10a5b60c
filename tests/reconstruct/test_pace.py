"""The time of an iteration follows from its parts that grow with cells, and those that do not."""

import pytest

from ddrecon.reconstruct import loop, tuning
from ddrecon.reconstruct.frame import Evaluation, Frame


@pytest.mark.parametrize("fewest", [16, 8, 4])
def test_a_line_through_two_resolutions(
    ball_scene, monkeypatch: pytest.MonkeyPatch, fewest: int
) -> None:
    """By a clock that counts 0.25 s and a millisecond a cell; twice that the first time."""
    monkeypatch.setattr(tuning, "FEWEST_CELLS", fewest)
    clock, known, evaluate = [0.0], set[int](), Frame.evaluate

    def evaluate_slowly(frame: Frame) -> Evaluation:
        cells = frame.level.train.volume.grid.cells
        clock[0] += (0.25 + cells / 1000) * (1 if cells in known else 2)
        known.add(cells)
        return evaluate(frame)

    monkeypatch.setattr(Frame, "evaluate", evaluate_slowly)
    monkeypatch.setattr(loop, "perf_counter", lambda: clock[0])
    cells = ball_scene.volume.grid.cells
    assert loop.time_iteration(ball_scene) == pytest.approx(0.25 + cells / 1000)
    assert len(known) == (1 if fewest == 16 else 2)
