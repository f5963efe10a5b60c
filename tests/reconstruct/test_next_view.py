"""Which picture next: the ensemble's promise against dense algebra, and without its bias."""

from __future__ import annotations

import pytest
import torch
from media import make_scene, random_values

from ddrecon.errors import UsageError
from ddrecon.uncertainty.next_view import find_error, find_gain, find_products, shots_around

SIZE, PIXELS = 40, 60


def normal(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def problem() -> tuple[torch.Tensor, torch.Tensor]:
    """The root of a covariance with long correlations, and a picture that blurs."""
    place = torch.linspace(0, 1, SIZE, dtype=torch.float64)
    covariance = torch.exp(-(((place[:, None] - place) / 0.05) ** 2))
    root = torch.linalg.cholesky(covariance + 1e-6 * torch.eye(SIZE))
    at = torch.linspace(0, 0.4, PIXELS, dtype=torch.float64)
    return root, torch.exp(-(((at[:, None] - place) / 0.1) ** 2)) / 8


def exact(root: torch.Tensor, picture: torch.Tensor) -> tuple[float, float]:
    """The part of the variance that the picture takes away, and the bound on it."""
    covariance = root @ root.T
    seen = picture @ covariance @ picture.T
    gain = covariance @ picture.T
    taken = gain @ torch.linalg.solve(seen + torch.eye(PIXELS), gain.T)
    once, twice = (gain @ gain.T).trace(), (gain @ seen @ gain.T).trace()
    total = covariance.trace()
    return float(taken.trace() / total), float(once**2 / (once + twice) / total)


def drawn(root: torch.Tensor, picture: torch.Tensor, count: int, seed: int) -> tuple:
    """Inner products of `count` samples, whose mean is not 0, and of their pictures."""
    samples = normal(count, SIZE, seed=seed) @ root.T + 3.0
    return find_products(samples), find_products(samples @ picture.T)


def in_span(alike: torch.Tensor, shown: torch.Tensor) -> float:
    """What the update of the ensemble promises (Bishop, Etherton and Majumdar 2001)."""
    eye = torch.eye(len(alike), dtype=torch.float64)
    left = torch.linalg.inv(eye + shown / len(shown))
    return float((alike @ (eye - left)).trace() / alike.trace())


def test_many_samples_find_the_bound() -> None:
    root, picture = problem()
    taken, bound = exact(root, picture)
    assert 0.1 < bound <= taken < 1
    assert find_gain(*drawn(root, picture, 600, 0)) == pytest.approx(bound, rel=0.06)


def test_few_samples_promise_no_more_than_many() -> None:
    root, picture = problem()
    taken, bound = exact(root, picture)
    pairs = [drawn(root, picture, 16, seed) for seed in range(100)]
    few = sum(find_gain(*pair) for pair in pairs) / len(pairs)
    spanned = sum(in_span(*pair) for pair in pairs) / len(pairs)
    assert few == pytest.approx(bound, rel=0.2) and spanned > 1.5 * taken


def test_the_error_is_how_much_gains_of_other_samples_differ() -> None:
    root, picture = problem()
    pairs = [drawn(root, picture, 12, seed) for seed in range(60)]
    gains = torch.tensor([find_gain(*pair) for pair in pairs])
    errors = torch.tensor([find_error(*pair) for pair in pairs])
    assert 0.6 < float(errors.square().mean().sqrt() / gains.std()) < 1.8


def test_a_picture_of_nothing_gains_nothing() -> None:
    root, picture = problem()
    assert find_gain(*drawn(root, 0 * picture, 8, 0)) == 0


def test_lights_that_cannot_be_turned_are_refused() -> None:
    dark = make_scene(random_values(3, 3, 3), directional=None, ambient=(1.0,))
    with pytest.raises(UsageError, match="turns directional lights"):
        shots_around(dark, "lights")
