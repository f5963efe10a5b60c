"""The search for a minimum within bounds, of quadratics and of what bends more."""

import io
import math

import pytest
import torch
from media import random_values

from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.search import Objective, Search, Space

COUNT = 12


def positive_matrix():
    """A matrix whose eigenvalues spread over three decades."""
    basis = torch.linalg.qr(random_values(COUNT, COUNT) - 0.5)[0]
    return basis @ torch.logspace(-1, 2, COUNT).double().diag() @ basis.T


MATRIX = positive_matrix()
TARGET = random_values(COUNT, seed=1) - 0.3


def quadratic(x):
    return (x - TARGET) @ MATRIX @ (x - TARGET) / 2


def rosenbrock(x):
    return (100 * (x[1::2] - x[::2] ** 2) ** 2 + (1 - x[::2]) ** 2).sum()


def space_of(metric, low):
    """Entries at least `low` in the diagonal `metric`."""

    def free(values, slope):
        return (~((values <= low) & (slope > 0))).to(values)

    return Space(
        lambda values: values.clamp(min=low),
        free,
        lambda values, free, vectors: vectors * free / metric,
        [COUNT],
    )


def objective_of(function, x, prior=None):
    """The objective at `x`, whose `prior` is none unless given."""
    leaf = x.clone().requires_grad_()
    loss = function(leaf)
    (slope,) = torch.autograd.grad(loss, leaf)
    if prior is None:
        return Objective(float(loss), 0.0, slope, torch.zeros_like(x))
    penalty = prior(leaf)
    (bar,) = torch.autograd.grad(penalty, leaf)
    return Objective(float(loss), float(penalty), slope, bar)


def begin(function, x, space, prior=None):
    search = Search(space, x)
    search.judge(objective_of(function, x, prior))
    return search


def advance(search, function, count):
    """Where `search` is after `count` candidates, or when no step helps."""
    for _ in range(count):
        if not search.is_stuck:
            search.judge(objective_of(function, search.candidate))
    return search.values


@pytest.mark.parametrize("low", [-10.0, 0.0])
def test_a_quadratic_within_bounds_is_solved(low):
    """What is not at a bound has no slope, and what is there would go beyond."""
    search = begin(quadratic, torch.ones(COUNT).double(), space_of(MATRIX.diagonal(), low))
    x = advance(search, quadratic, 100)
    slope = MATRIX @ (x - TARGET)
    is_held = x <= low
    assert bool(is_held.any()) == (low == 0)
    scale = float(MATRIX.diagonal().max())
    assert float(slope[~is_held].abs().max()) < 1e-6 * scale and bool((slope[is_held] > 0).all())


def test_its_loss_never_rises_and_reaches_the_end_of_a_curved_valley():
    space = space_of(torch.ones(COUNT).double(), -10.0)
    search, losses = begin(rosenbrock, -torch.ones(COUNT).double(), space), list[float]()
    while search.loss > 1e-12:
        advance(search, rosenbrock, 1)
        losses.append(search.loss)
        assert len(losses) < 200
    assert losses == sorted(losses, reverse=True)


def test_a_direction_is_minus_the_inverse_hessian_of_its_pairs_times_the_slope():
    """The matrix of Broyden, Fletcher, Goldfarb and Shanno, updated pair by pair as a whole."""
    metric = 1 + random_values(COUNT, seed=2)
    search = begin(rosenbrock, random_values(COUNT, seed=3), space_of(metric, -10.0))
    advance(search, rosenbrock, 6)
    assert 3 <= len(search.pairs) <= tuning.PAIRS
    inverse = search.scales[0] * metric.reciprocal().diag()
    for move, change, _ in search.pairs:
        s, y = move, change
        rest = torch.eye(COUNT).double() - torch.outer(y, s) / (s @ y)
        inverse = rest.T @ inverse @ rest + torch.outer(s, s) / (s @ y)
    slope = search.objective.gradient
    torch.testing.assert_close(search.direction, -inverse @ slope, rtol=1e-9, atol=1e-12)
    # The last move is what the last change of the slope asks for.
    move, change, _ = search.pairs[-1]
    torch.testing.assert_close(inverse @ change, move)
    assert search.gains[-1] == pytest.approx(float(slope @ inverse @ slope) / 2 / search.loss)


def test_units_of_unknowns_change_nothing():
    """Where the metric is in the same units."""
    unit, start = 10 ** (4 * random_values(COUNT, seed=4) - 2), random_values(COUNT, seed=3)
    metric = 1 + random_values(COUNT, seed=2)
    plain = begin(rosenbrock, start, space_of(metric, -10.0))

    def scaled(x):
        return rosenbrock(x * unit)

    other = begin(scaled, start / unit, space_of(metric * unit**2, -1e9))
    for _ in range(12):
        x, scaled_x = advance(plain, rosenbrock, 1), advance(other, scaled, 1)
        torch.testing.assert_close(scaled_x * unit, x, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("loss", [float("nan"), float("inf"), 1e9])
def test_a_candidate_that_is_no_better_shortens_the_step(loss):
    search = begin(quadratic, torch.ones(COUNT).double(), space_of(MATRIX.diagonal(), -10.0))
    before, step, values = search.loss, search.step, search.values
    nothing = torch.full((COUNT,), torch.nan).double()
    assert not search.judge(Objective(loss, 0.0, nothing, nothing))
    assert 0.1 * step <= search.step <= 0.5 * step
    assert search.loss == before and search.values is values and not search.pairs
    # Where no step helps it says so, and does not move.
    for _ in range(100):
        if not search.is_stuck:
            search.judge(Objective(loss, 0.0, nothing, nothing))
    assert search.is_stuck and search.gain == 0.0 and search.values is values


def test_pairs_know_both_curvatures_by_whatever_weight_the_prior_has():
    """So a search whose prior is reweighed goes on as if it had always had that weight."""

    def prior(x):
        return x.square().sum()

    start, space = random_values(COUNT, seed=3), space_of(MATRIX.diagonal(), -10.0)
    search = begin(quadratic, start, space, prior)
    for _ in range(4):
        search.judge(objective_of(quadratic, search.candidate, prior))
    assert search.gain < math.inf
    search.reweigh(0.25)
    assert search.gain == math.inf  # what was known of it was by the weight before
    slope = search.objective.slope(0.25)
    x = search.values
    torch.testing.assert_close(slope, MATRIX @ (x - TARGET) + 0.5 * x)
    move, of_loss, of_prior = search.pairs[-1]
    torch.testing.assert_close(of_loss, MATRIX @ move)
    torch.testing.assert_close(of_prior, 2 * move)
    assert search.slope == pytest.approx(float(search.direction @ slope)) and search.slope < 0


def test_a_search_goes_on_from_its_state_to_the_same_bits():
    space = space_of(torch.ones(COUNT).double(), -10.0)
    whole = begin(rosenbrock, random_values(COUNT, seed=3), space)
    for _ in range(15):
        file = io.BytesIO()
        torch.save(whole.state(), file)
        file.seek(0)
        resumed = Search(space, torch.ones(COUNT).double())
        resumed.restore(torch.load(file, weights_only=True))
        both = [advance(search, rosenbrock, 1) for search in (whole, resumed)]
        assert torch.equal(*both) and resumed.step == whole.step
