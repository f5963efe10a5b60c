"""The loop gets closer, stays within bounds, stops cleanly, and goes on as if never stopped."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from ddrecon.errors import DivergenceError, FormatError, SceneError
from ddrecon.io.volumes.table import read_field
from ddrecon.reconstruct.log import Result
from ddrecon.reconstruct.loop import Reconstruction, optimize
from ddrecon.run.checkpoint import FORMAT, load_checkpoint
from ddrecon.scene import Scene, View

TRUTH = Path(__file__).parents[2] / "data" / "ball" / "density.npz"


def error_of(density: torch.Tensor) -> float:
    truth = torch.as_tensor(read_field(TRUTH, "density").values)
    return float((density - truth).abs().sum() / truth.sum())


def test_an_empty_volume_comes_closer_to_the_truth(ball_scene: Scene) -> None:
    assert ball_scene.optimize is not None
    by_all_views = replace(ball_scene, optimize=replace(ball_scene.optimize, views_per_iteration=0))
    result = optimize(by_all_views, iterations=12)
    losses = [row.loss for row in result.rows]
    assert losses[-1] < 0.25 * losses[0]
    assert error_of(result.scene.volume.density) < 0.9 * error_of(ball_scene.starts["density"])
    assert result.scene.volume.density.shape == ball_scene.volume.density.shape
    assert result.rows[-1].test_psnr is not None


def test_the_scene_itself_is_left_alone(ball_scene: Scene) -> None:
    before = ball_scene.volume.density.clone()
    optimize(ball_scene, iterations=2)
    assert torch.equal(ball_scene.volume.density, before)
    assert not ball_scene.volume.density.requires_grad


def test_test_views_do_not_influence_the_result(ball_scene: Scene) -> None:
    views = [replace(view, image=view.image * (not view.is_test)) for view in ball_scene.views]
    spoiled = replace(ball_scene, views=views)
    one, other = (optimize(scene, iterations=3).scene.volume for scene in (ball_scene, spoiled))
    assert torch.equal(one.density, other.density)


def test_a_view_of_weight_2_counts_as_two(ball_scene: Scene) -> None:
    settings = replace(ball_scene.optimize, views_per_iteration=0, refine_at=())
    first, second = ball_scene.views[:2]
    second = replace(second, image=first.image.flip(2))  # as bright, which is the unit of losses

    def found(*views: View) -> Result:
        return optimize(replace(ball_scene, views=[*views], optimize=settings), iterations=2)

    heavy = found(replace(first, weight=6.0), replace(second, weight=3.0))
    twice, once = found(first, replace(first, name="again"), second), found(first, second)
    for one, other in zip(heavy.rows, twice.rows, strict=True):
        assert one.data_loss == pytest.approx(other.data_loss, rel=1e-5)
    densities = [each.scene.volume.density for each in (heavy, twice, once)]
    torch.testing.assert_close(densities[0], densities[1], rtol=1e-3, atol=1e-5)
    assert not torch.allclose(densities[0], densities[2], rtol=1e-3, atol=1e-5)


def test_brightness_of_the_light_does_not_matter(ball_scene: Scene) -> None:
    sun, sky = ball_scene.lights
    lights = [
        replace(sun, irradiance=16 * sun.irradiance),
        replace(sky, radiance=16 * sky.radiance),
    ]
    views = [replace(view, image=16 * view.image) for view in ball_scene.views]
    bright = replace(ball_scene, views=views, lights=lights)
    plain, scaled = optimize(ball_scene, iterations=3), optimize(bright, iterations=3)
    assert torch.allclose(plain.scene.volume.density, scaled.scene.volume.density, atol=1e-3)


def test_a_checkpoint_of_another_format_is_refused(tmp_path: Path):
    torch.save({"format": 1, "scene": {}, "state": {}}, tmp_path / "last.pt")
    with pytest.raises(FormatError, match=f"of format 1; this version reads {FORMAT}"):
        load_checkpoint(tmp_path, {})


@pytest.mark.parametrize("flaw", ["loss of view", "derivative of the loss"])
def test_divergence_keeps_the_last_good_state(
    ball_scene: Scene, flaw: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = replace(ball_scene.optimize, views_per_iteration=0, refine_at=())
    run = Reconstruction(replace(ball_scene, optimize=settings))
    run.step()
    good = run.parameters[0].value.detach().clone()
    run.step()
    if flaw == "loss of view":
        run.level.train.views[0].image[0, 3, 4] = math.inf
    else:
        gradients = {"density": torch.full_like(good, math.nan)}
        monkeypatch.setattr(
            "ddrecon.reconstruct.loop.add_penalties", lambda found, *_: (found.loss, gradients)
        )
    with pytest.raises(DivergenceError, match=f"{flaw} .* is not finite"):
        run.step()
    assert torch.equal(run.parameters[0].value, good)
    assert run.iteration == 1


def test_a_scene_without_training_images_is_refused(ball_scene: Scene) -> None:
    with pytest.raises(SceneError, match="nothing to reconstruct from"):
        tests = [view for view in ball_scene.views if view.is_test]
        Reconstruction(replace(ball_scene, views=tests))
    with pytest.raises(SceneError, match="missing section"):
        Reconstruction(replace(ball_scene, optimize=None))
