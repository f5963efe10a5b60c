"""Which picture next: the ensemble's promise against dense algebra, and without its bias."""

import pytest
import torch

from ddrecon.uncertainty.next_view import find_error, find_gain, find_products, gains_but_one

PLACE = torch.linspace(0, 1, 40).double()
COVARIANCE = torch.exp(-(((PLACE[:, None] - PLACE) / 0.05) ** 2))
PICTURE = torch.exp(-(((torch.linspace(0, 0.4, 60)[:, None] - PLACE) / 0.1) ** 2)) / 8
"""A prior with long correlations, and a picture that blurs."""
SEEN, GAIN = PICTURE @ COVARIANCE @ PICTURE.T, COVARIANCE @ PICTURE.T
ONCE, TWICE = (GAIN @ GAIN.T).trace(), (GAIN @ SEEN @ GAIN.T).trace()
BOUND = float(ONCE**2 / (ONCE + TWICE) / COVARIANCE.trace())


def drawn(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Inner products of `count` samples, and of their pictures."""
    root = torch.linalg.cholesky(COVARIANCE + 1e-6 * torch.eye(len(PLACE)))
    generator = torch.Generator().manual_seed(seed)
    samples = torch.randn(count, len(PLACE), generator=generator).double() @ root.T
    return find_products(list(samples)), find_products(list(samples @ PICTURE.T))


def test_a_gain_is_a_bound_that_few_samples_find_on_average_and_their_error() -> None:
    taken = GAIN @ torch.linalg.solve(SEEN + torch.eye(len(PICTURE)), GAIN.T)
    assert 0.1 < BOUND <= float(taken.trace() / COVARIANCE.trace()) < 1
    assert find_gain(*drawn(600, 0)) == pytest.approx(BOUND, rel=0.06)
    pairs = [drawn(16, seed) for seed in range(100)]
    gains = torch.tensor([find_gain(*pair) for pair in pairs])
    errors = torch.tensor([find_error(gains_but_one(*pair)) for pair in pairs])
    assert float(gains.mean()) == pytest.approx(BOUND, rel=0.2)
    assert 0.6 < float(errors.square().mean().sqrt() / gains.std()) < 1.8
