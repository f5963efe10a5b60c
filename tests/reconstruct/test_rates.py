"""Learning rates: a rise, a fall, the same run in all units; which views an iteration sees."""

from dataclasses import replace

import pytest
import torch
from media import make_scene, random_values

from ddrecon.medium.mixture import mix_media
from ddrecon.reconstruct.schedule import pick_views, rate_at
from ddrecon.scene import Scene
from ddrecon.variables.kinds import kind_of


def test_rates_fall_and_never_exceed_their_value() -> None:
    rates = [rate_at(iteration, 100, 10, 0.2) for iteration in range(100)]
    assert not any(rates[:10]) and all(0 < rate <= 1 for rate in rates[10:])
    assert rates[10:] == sorted(rates[10:], reverse=True)


def test_brighter_light_moves_faster_in_proportion(ball_scene: Scene) -> None:
    name, rate = "lights.0.irradiance", kind_of("lights.0.irradiance").rate
    one, ten = (rate(ball_scene, name, torch.full((3,), value)) for value in (1.0, 10.0))
    assert ten == pytest.approx(10 * one)


def test_a_medium_moves_as_it_would_alone() -> None:
    """Whatever is in the same place: a step has the same optical depth of each."""
    thin, thick = (make_scene(random_values(4, 4, 4), sigma_s=(s,)).volume for s in (0.01, 1e3))
    both = replace(make_scene(thin.density), volume=mix_media({"air": thin, "cloud": thick}))
    for medium, volume in both.volume.media.items():
        alone = kind_of("density").rate(replace(both, volume=volume), "density", volume.density)
        name = f"media.{medium}.density"
        assert kind_of(name).rate(both, name, volume.density) == alone


@pytest.mark.parametrize(("count", "wanted"), [(10, 3), (7, 1), (6, 2)])
def test_every_view_is_seen_once_before_any_comes_again(count: int, wanted: int) -> None:
    seen = [one for turn in range(count) for one in pick_views(count, wanted, turn, 0)]
    assert len(seen) == count * wanted
    for start in range(0, len(seen), count):
        assert sorted(seen[start : start + count]) == list(range(count))
    assert pick_views(count, 0, 3, 0) == pick_views(count, 99, 3, 0) == list(range(count))


def test_the_order_differs_from_round_to_round_and_follows_the_seed() -> None:
    drawn = [pick_views(8, 1, iteration, 0)[0] for iteration in range(32)]
    assert len({tuple(drawn[start : start + 8]) for start in range(0, 32, 8)}) > 1
    orders = (tuple(pick_views(8, 1, turn, seed)[0] for turn in range(8)) for seed in range(4))
    assert len(set(orders)) > 1
