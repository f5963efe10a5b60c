"""Reconstructions that share their numbers: copies of one agree with it, and all move as one."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from ddrecon import Scene, load_scene
from ddrecon.reconstruct.frame import Frame
from ddrecon.reconstruct.levels import scene_at_level
from ddrecon.reconstruct.loop import Reconstruction

NUMBERS = ["views.*.exposure", "lights.0.irradiance"]


@pytest.fixture
def still() -> Scene:
    """The ball, with numbers to find beside its density, in float64; cameras need more pictures."""
    sought = [f"optimize.parameters.{name}={{}}" for name in NUMBERS]
    overrides = ["optimize.iterations=4", "diffusion.transport_rounds=0", *sought]
    scene = load_scene("configs/ball.yaml", overrides=overrides, dtype=torch.float64)
    return scene_at_level(scene, 2)


def values(run: Reconstruction | Frame) -> dict[str, Tensor]:
    return {p.name: p.value.detach() for p in run.parameters}


@pytest.mark.slow
def test_copies_of_a_scene_find_what_it_finds_alone(still: Scene) -> None:
    single, together = Reconstruction(still), Reconstruction(still, others=[still])
    while not single.is_done:
        row, rows = single.step(), together.advance()
        assert [other.loss for other in rows] == pytest.approx([row.loss] * 2, rel=1e-6)
    assert together.is_done
    for run in together.frames:
        torch.testing.assert_close(values(run), values(single), rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_volumes_differ_and_numbers_do_not(still: Scene) -> None:
    other = replace(still, views=[replace(view, image=0.5 * view.image) for view in still.views])
    together = Reconstruction(still, others=[other])
    together.advance()
    state = together.state()
    rows = together.advance()
    one, two = map(values, together.frames)
    for name in one:
        assert torch.equal(one[name], two[name]) == (name != "density")
    # It goes on from its state to the same bits.
    again = Reconstruction(still, others=[other])
    again.restore(state)
    assert [row.loss for row in again.advance()] == [row.loss for row in rows]
    for run, resumed in zip(together.frames, again.frames, strict=True):
        torch.testing.assert_close(values(resumed), values(run), rtol=0, atol=0)
