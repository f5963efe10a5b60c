"""Samples of what a reconstruction may as well be: its posterior about its optimum (E33).

Randomize, then optimize (Bardsley, Solonen, Haario and Laine 2014, doi:10.1137/140964023), with
pictures as they change to first order: each sample is the least, within bounds, of a quadratic
whose data and prior were disturbed as much as they err.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.numerics.conjugate_gradients import Solved, conjugate_gradients
from ddrecon.reconstruct.curvature import Curvature
from ddrecon.reconstruct.limits import find_bounds, find_gauge, find_kept
from ddrecon.reconstruct.prior import PRECONDITION, Prior, normal_like

TOLERANCE = 0.2
"""How small a sample's residual is to be, of what it was for a draw from the prior."""
MOST = 40
"""Products with J^T W J that a sample may take."""
ROUNDS = 10
"""Times that cells are let go of or held at a bound."""
CUT = 1e-3
"""A step of which less than this part is cut at bounds counts as whole."""
PROBES = 3
"""Random pictures that the diagonal of J^T W J is found by."""


@dataclass(frozen=True)
class Sample:
    """How far from the optimum a draw from the posterior is, `change` [n], and one from the prior.

    Both are of the same disturbance of the prior; that from the prior leaves out what single
    numbers and levels of smoothed fields do. `products` with J^T W J were needed; `residual` is
    what is left.
    """

    change: Tensor
    prior: Tensor
    products: int
    residual: float


class Posterior:
    """The posterior about the values of `curvature`, of pictures that err by `temperature`.

    `gradient` [n] is the objective's: it presses entries at a bound against it. Entries stay where
    `is_kept` [n]; changes have no part in the orthonormal `gauge` [n, k].
    """

    def __init__(
        self,
        curvature: Curvature,
        gradient: Tensor,
        temperature: float,
        seed: int,
        tolerance: float = TOLERANCE,
    ):
        self.curvature, self.temperature = curvature, temperature
        self.seed, self.tolerance, self.most = seed, tolerance, MOST
        self.prior = Prior(curvature, temperature)
        value = curvature.join(curvature.values)
        self.low, self.high = (bound - value for bound in find_bounds(curvature))
        self.is_kept = find_kept(curvature)
        at_bound = (self.low >= 0) & (gradient > 0) | (self.high <= 0) & (gradient < 0)
        # The optimum is one: what is left of a derivative elsewhere belongs to the optimizer.
        self.gradient = torch.where(at_bound, gradient, 0)
        self.gauge = find_gauge(curvature)
        self.diagonal = self._diagonal()

    def sample(self, number: int) -> Sample:
        """The sample of this `number`, the same whenever it is asked for."""
        generator = self._generator(number)
        scale = self.temperature**0.5
        noise, level = (scale * part for part in self.prior.root_noise(generator))
        even = self.prior.without_levels(self._solve_prior(noise), self.is_kept)
        prior = self._within(even)
        right = noise + level - self.gradient - self.prior.product(prior)
        # What is lacking at the draw from the prior: both parts of the data in one adjoint.
        changes, disturbed = self.curvature.tangents(prior), self._disturbances(generator)
        weights = self.curvature.weights
        right += self.curvature.adjoint(
            {name: scale * disturbed[name] - w * changes[name] for name, w in weights.items()}
        )
        change, products, residual = self._minimize(prior, right)
        return Sample(change, prior, products, residual)

    def data_noise(self, generator: torch.Generator) -> Tensor:
        """A random vector whose covariance is J^T W J."""
        return self.curvature.adjoint(self._disturbances(generator))

    def _disturbances(self, generator: torch.Generator) -> dict[str, Tensor]:
        """W^(1/2) times white noise, by the name of a view."""
        images = self.curvature.images
        weights = self.curvature.weights.items()
        return {name: w.sqrt() * normal_like(images[name], generator) for name, w in weights}

    def count_told(self) -> float:
        """How many numbers the pictures tell: an estimate of the trace of H^-1 J^T W J.

        By one random vector, without bounds.
        """
        noise = self.data_noise(self._generator(-2))
        change = self._correct(noise, self.is_kept, self.most).value
        return float(noise @ change)

    def product(self, vector: Tensor) -> Tensor:
        """H times `vector`, H being J^T W J + R + T K."""
        return self.curvature.data_product(vector) + self.prior.product(vector)

    def _minimize(self, change: Tensor, residual: Tensor) -> tuple[Tensor, int, float]:
        """The least, within bounds, of a quadratic, from `change` where `residual` is lacking.

        And how many products that took, and what is left. Which cells are at a bound is guessed,
        the others are solved for, and the guess is mended (active sets: Bertsekas 1982,
        doi:10.1137/0320018).
        """
        products, first, left = 1, 0.0, 1.0
        for _ in range(ROUNDS):
            is_held = (change <= self.low) & (residual < 0) | (change >= self.high) & (residual > 0)
            is_fixed = self.is_kept | is_held
            size = self._size(residual, is_fixed)
            first = first or size
            left = size / first if first else 0.0
            if left <= self.tolerance or products >= self.most:
                break
            solved = self._correct(residual, is_fixed, self.most - products, self.tolerance / left)
            products, residual = products + solved.products, solved.lacking
            wanted = change + solved.value
            change = self._within(wanted)
            # Where hardly anything was cut at a bound, no product is spent on it.
            cut = change - wanted
            if float(cut.norm()) > CUT * float(solved.value.norm()):
                residual = residual - self.product(cut)
                products += 1
        return change, products, left

    def _correct(
        self, right: Tensor, is_fixed: Tensor, most: int, tolerance: float = TOLERANCE
    ) -> Solved:
        """The change of all that is not fixed that H takes to `right`."""

        def precondition(vector: Tensor) -> Tensor:
            free = self._without_gauge(vector.masked_fill(is_fixed, 0))
            ready = self._precondition(free, is_fixed)
            return self._without_gauge(ready.masked_fill(is_fixed, 0))

        return conjugate_gradients(self.product, precondition, right, tolerance, most)

    def _precondition(self, vector: Tensor, is_fixed: Tensor) -> Tensor:
        """About H^-1 `vector`: what pictures say counts by its diagonal alone."""
        return self.prior.solve(vector, is_fixed, self.diagonal, PRECONDITION)

    def _size(self, residual: Tensor, is_fixed: Tensor) -> float:
        free = self._without_gauge(residual.masked_fill(is_fixed, 0))
        return max(float(free @ self._precondition(free, is_fixed)), 0.0) ** 0.5

    def _solve_prior(self, right: Tensor) -> Tensor:
        """The draw from the prior whose disturbance is `right`."""
        return self._without_gauge(self.prior.solve(right, self.is_kept))

    def _within(self, change: Tensor) -> Tensor:
        """`change`, cut where a bound is."""
        return torch.maximum(torch.minimum(change, self.high), self.low)

    def _without_gauge(self, vector: Tensor) -> Tensor:
        if self.gauge is None:
            return vector
        return vector - self.gauge @ (self.gauge.T @ vector)

    def _diagonal(self) -> Tensor:
        """About the diagonal of J^T W J: the mean square of J^T W^(1/2) of random signs."""
        generator, total = self._generator(-1), torch.zeros_like(self.low)
        for _ in range(PROBES):
            signs = {
                name: w.sqrt() * normal_like(self.curvature.images[name], generator).sign()
                for name, w in self.curvature.weights.items()
            }
            total += self.curvature.adjoint(signs).square() / PROBES
        return total

    def _generator(self, number: int) -> torch.Generator:
        """What draws the numbers of a sample; below 0 those of other random vectors."""
        return torch.Generator().manual_seed((self.seed % 2**31) * 1_000_003 + number + 2)
