"""The derivative check passes for the program and catches a derivative that is wrong."""

from pathlib import Path

import pytest
import torch

from ddrecon.diffusion import implicit
from ddrecon.scene.build import load_scene
from ddrecon.validate.gradcheck import check_density

BALL = Path(__file__).parents[2] / "configs" / "ball.yaml"
SMALL = ["volume.resolution=[6, 5, 4]", "diffusion.solver=conjugate_gradient"]


def check():
    torch.set_num_threads(2)
    scene = load_scene(BALL, overrides=SMALL, dtype=torch.float64)
    scene.views = scene.views[:2]
    return check_density(scene, 4, 0, lambda items, _: items)


def test_the_program_passes() -> None:
    result = check()
    assert result.has_passed, result.lines()
    assert {entry.density == 0 for entry in result.entries} == {True, False}


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_broken_adjoint_is_caught(monkeypatch: pytest.MonkeyPatch, axis: int) -> None:
    right = implicit._Solve.backward

    def wrong(ctx, u_bar):
        bars = list(right(ctx, u_bar))
        bars[3 + axis] = 0.99 * bars[3 + axis]
        return tuple(bars)

    monkeypatch.setattr(implicit._Solve, "backward", staticmethod(wrong))
    assert not check().has_passed
