"""Samples of what a reconstruction may as well be: its posterior about its optimum (E11.4).

Randomize, then optimize (Bardsley, Solonen, Haario and Laine 2014, doi:10.1137/140964023), with
pictures as they change to first order: each sample is the least, within bounds, of a quadratic
whose data and prior were disturbed as much as they err.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.numerics.around import mean_around
from ddrecon.numerics.conjugate_gradients import Solved, conjugate_gradients
from ddrecon.reconstruct.curvature import Curvature
from ddrecon.reconstruct.numbers import find_gauges, number_curvature, single_numbers
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.uncertainty.prior import DIAGONAL, Prior, normal_like, rounding_of

TOLERANCE = 0.5
"""How small a sample's residual is to be, of a right side's usual size."""
NUMBERS = 0.01
"""And where there are single numbers, which hang on all cells and come last."""
TOLD = 0.4
"""And that of the change by which told numbers are counted: they err by its square."""
MOST = 40
"""Products with J^T W J that a sample may take."""
ROUNDS = 10
"""Times that cells are let go of or fixed at a bound."""
INNER = 6
"""Steps of each solve that conjugate gradients are preconditioned with,"""
PRECONDITION = 0.1
"""or fewer, where so small a part of the residual is left."""
PROBED = -1
"""The number of random vectors that belong to no sample, but to information."""
GAUGE = 1e6
"""How much more than by pictures a number is constrained by what no picture shows."""
BEGIN = 0.25
"""The part of the way from a draw of the prior to what pictures roughly leave of it."""


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
    `is_kept` [n]; changes have no part in the orthonormal `gauge` [n, k]. `information` is what
    `curvature` is about, where that was found before.
    """

    def __init__(
        self,
        curvature: Curvature,
        gradient: Tensor,
        temperature: float,
        seed: int,
        tolerance: float = TOLERANCE,
        information: Information | None = None,
    ):
        self.curvature, self.temperature = curvature, temperature
        self.seed, self.tolerance, self.most = seed, tolerance, MOST
        self.prior = Prior(curvature, temperature)
        value, parameters = curvature.join(curvature.values), curvature.parameters

        def entries(number_of: Callable[[Parameter], float]) -> Tensor:
            return curvature.join(
                {p.name: torch.full_like(p.value, number_of(p)) for p in parameters}
            )

        self.low, self.high = entries(lambda p: p.low) - value, entries(lambda p: p.high) - value
        # What rounding leaves of a cell that no picture shows is at its bound.
        self.near = entries(rounding_of)
        # Cells outside of a field's support stay as they are.
        supports = [(p, p.support) for p in parameters if p.support is not None]
        kept = {p.name: (support == 0).expand(p.value.shape).to(p.value) for p, support in supports}
        self.is_kept = curvature.join(kept) > 0
        at_bound = self._is_at_bound(torch.zeros_like(gradient), -gradient)
        # The optimum is one: what is left of a derivative elsewhere belongs to the optimizer.
        self.gradient = torch.where(at_bound, gradient, 0)
        self.gauge = find_gauge(curvature)
        numbers = single_numbers(parameters)
        self.is_number = curvature.join({p.name: torch.ones_like(p.value) for p in numbers}).bool()
        # Between them H is what pictures say, and how they are constrained without.
        precisions = [
            torch.atleast_1d(self.prior.precision[p.name].double().cpu()) for p in numbers
        ]
        blocks = [
            block if block.ndim == 2 else block * torch.eye(p.value.numel())
            for p, block in zip(numbers, precisions, strict=True)
        ]
        self.between = number_curvature(curvature, numbers) + torch.block_diag(*blocks).double()
        self.information = information or Information(curvature, generator_of(seed, PROBED))

    def sample(self, number: int) -> Sample:
        """The sample of this `number`, the same whenever it is asked for."""
        generator = generator_of(self.seed, number)
        scale = self.temperature**0.5
        noise, level = (scale * part for part in self.prior.root_noise(generator))
        draw = self._without_gauge(self.prior.solve(noise, self.is_kept))
        prior = self._within(self.prior.without_levels(draw, self.is_kept))
        right = noise + level - self.gradient
        # It begins at the draw, and a part of the way on to what pictures leave of it.
        is_fixed = self.is_kept | self._is_at_bound(prior, right)
        begin = self._within(prior + BEGIN * (self._precondition(right, is_fixed) - prior))
        # The residual there: both parts of the data in one adjoint.
        changes, disturbed = self.curvature.tangents(begin), self._disturbances(generator)
        weights = self.curvature.weights
        residual = right - self.prior.product(begin)
        residual += self.curvature.adjoint(
            {name: scale * disturbed[name] - w * changes[name] for name, w in weights.items()}
        )
        change, products, left = self.minimize(begin, residual)
        return Sample(change, prior, products, left)

    def _disturbances(self, generator: torch.Generator) -> dict[str, Tensor]:
        """W^(1/2) times white noise, by the name of a view."""
        images = self.curvature.images
        weights = self.curvature.weights.items()
        return {name: w.sqrt() * normal_like(images[name], generator) for name, w in weights}

    def count_told(self) -> float:
        """How many numbers the pictures tell: an estimate of the trace of H^-1 J^T W J.

        By one random vector of the covariance J^T W J, without bounds.
        """
        noise = self.information.probe
        change = self._correct(noise, self.is_kept, self.most, TOLD).value
        return float(noise @ change)

    def product(self, vector: Tensor) -> Tensor:
        """H times `vector`, H being J^T W J + R + T K."""
        return self.curvature.data_product(vector) + self.prior.product(vector)

    def _is_at_bound(self, change: Tensor, residual: Tensor) -> Tensor:
        """Which entries are at a bound that `residual` presses them against."""
        is_low, is_high = change - self.low <= self.near, self.high - change <= self.near
        return is_low & (residual < 0) | is_high & (residual > 0)

    def minimize(self, change: Tensor, residual: Tensor) -> tuple[Tensor, int, float]:
        """The least, within bounds, of a quadratic, from `change` with its `residual`.

        And how many products that took, and what is left. Which cells are at a bound is guessed,
        the others are solved for, and the guess is mended (active sets: Bertsekas 1982,
        doi:10.1137/0320018).
        """
        products, left = 1, 1.0
        for _ in range(ROUNDS):
            is_fixed = self.is_kept | self._is_at_bound(change, residual)
            guess = self._precondition(residual, is_fixed)
            left = self.size(residual, is_fixed, guess)
            if left <= self.tolerance or products >= self.most:
                break
            most, tolerance = self.most - products, self.tolerance / left
            solved = self._correct(residual, is_fixed, most, tolerance, guess)
            products, residual = products + solved.products, solved.lacking
            moved = change + solved.value
            change = self._within(moved)
            # What was cut at bounds counts roughly first: where that does, no product is spent.
            cut = change - moved
            rough = residual - self._rough_product(cut)
            left = self.size(rough, self.is_kept | self._is_at_bound(change, rough))
            if left <= self.tolerance:
                break
            residual, products = residual - self.product(cut), products + 1
        return change, products, left

    def _correct(
        self,
        right: Tensor,
        is_fixed: Tensor,
        most: int,
        tolerance: float = TOLERANCE,
        guess: Tensor | None = None,
    ) -> Solved:
        """The change of all that is not fixed that H takes to `right`.

        `guess` is what the preconditioner makes of it, where that is known.
        """

        def precondition(part: Tensor) -> Tensor:
            return self._precondition(part, is_fixed)

        return conjugate_gradients(self.product, precondition, right, tolerance, most, guess)

    def _precondition(self, vector: Tensor, is_fixed: Tensor) -> Tensor:
        """About H^-1 `vector`, with 0 where `is_fixed`: J^T W J counts by its `information`.

        That again is solved by conjugate gradients, to which it counts by its diagonal alone.
        Single numbers are solved for by themselves, all together.
        """
        is_out = is_fixed | self.is_number

        def precondition(part: Tensor) -> Tensor:
            return self.prior.solve(part, is_out, self.information.diagonal, DIAGONAL)

        free = self._without_gauge(vector.masked_fill(is_fixed, 0))
        fields = free.masked_fill(is_out, 0)
        guess = conjugate_gradients(
            self._rough_product, precondition, fields, PRECONDITION, INNER
        ).value.masked_fill(is_out, 0)
        at = self.is_number
        if len(self.between):
            gauge = None if self.gauge is None else self.gauge[at]
            guess[at] = solve_numbers_within(self.between, free[at], is_fixed[at], gauge)
        return self._without_gauge(guess)

    def _rough_product(self, vector: Tensor) -> Tensor:
        """About H times `vector`: J^T W J by its `information`."""
        return self.information.product(vector) + self.prior.product(vector)

    def size(self, residual: Tensor, is_fixed: Tensor, guess: Tensor | None = None) -> float:
        """How large `residual` is, about 1 being what a right side is on average.

        `guess` is `residual` preconditioned, where that is known.
        """
        guess = self._precondition(residual, is_fixed) if guess is None else guess
        free = int((~is_fixed).sum())
        return (max(float(residual @ guess), 0.0) / (self.temperature * max(free, 1))) ** 0.5

    def _within(self, change: Tensor) -> Tensor:
        return torch.maximum(torch.minimum(change, self.high), self.low)

    def _without_gauge(self, vector: Tensor) -> Tensor:
        if self.gauge is None:
            return vector
        return vector - self.gauge @ (self.gauge.T @ vector)


def generator_of(seed: int, number: int) -> torch.Generator:
    """What draws the numbers of sample `number` >= 0, or those `PROBED`."""
    return torch.Generator().manual_seed((seed % 2**31) * 1_000_003 + number + 2)


def find_gauge(curvature: Curvature) -> Tensor | None:
    """What changes have no part in, as orthonormal columns [n, k]; None where there is nothing.

    That is what no picture shows (see `gauges`), and the length of a direction.
    """
    columns, values = list[Tensor](), curvature.values
    for gauge in find_gauges(curvature.scene, curvature.parameters):
        sizes = [parameter.value.numel() for parameter in gauge.parameters]
        for column in gauge.directions.T:
            parts = zip(gauge.parameters, column.split(sizes), strict=True)
            # Of a relative gauge, changes are those of logarithms.
            columns.append(
                curvature.join(
                    {
                        p.name: part / values[p.name].flatten() if gauge.is_relative else part
                        for p, part in parts
                    }
                )
            )
    columns += [
        curvature.join({p.name: values[p.name]}) for p in curvature.parameters if p.is_direction
    ]
    return torch.linalg.qr(torch.stack(columns, 1))[0] if columns else None


def solve_numbers_within(
    matrix: Tensor, right: Tensor, is_fixed: Tensor, gauge: Tensor | None
) -> Tensor:
    """x [k] with `matrix` [k, k] x = `right` [k] where not `is_fixed`, there 0; `gauge`^T x is 0.

    `gauge` [k, j] has what no picture shows in its columns.
    """
    free = ~is_fixed.to(matrix.device)
    scaled, unit = matrix[free][:, free], matrix.diagonal()[free].clamp(min=1e-300).rsqrt()
    scaled = scaled * unit * unit[:, None]
    if gauge is not None:
        constraint = gauge.to(matrix)[free] * unit[:, None]
        constraint = constraint / constraint.norm(dim=0).clamp(min=1e-300)
        scaled = scaled + GAUGE * constraint @ constraint.T
    solved = torch.zeros_like(right)
    solved[free] = (unit * torch.linalg.solve(scaled, unit * right.to(matrix)[free])).to(right)
    return solved


PROBES = 3
"""Random pictures that it is found by."""
AXES = (-3, -2, -1)


class Information:
    """About J^T W J of `curvature`: its `diagonal` [n], and of each field a spectrum.

    Pictures tell sums along rays: smooth changes of a field far better than rough ones. How that
    hangs together is nearly the same everywhere, but for its scale, and a few random pictures show
    both. Products are cheap, so that equations can be solved with it.

    `generator` draws the random pictures. `probe` [n] is what one of them gives, a random vector
    whose covariance is J^T W J.
    """

    def __init__(self, curvature: Curvature, generator: torch.Generator):
        self.curvature = curvature
        found = [self._probe(generator) for _ in range(PROBES)]
        probes, self.probe = [curvature.split(each) for each in found], found[0]
        squares = {
            name: torch.stack([probe[name].square() for probe in probes]).mean(0)
            for name in curvature.values
        }
        fields = [parameter.name for parameter in curvature.parameters if parameter.is_field]
        for name in fields:
            squares[name] = mean_around(squares[name])
        self.diagonal = curvature.join(squares)
        self.roots = {name: squares[name].sqrt() for name in fields}
        tiny = torch.finfo(self.diagonal.dtype).tiny
        self.spectra = {
            name: _find_spectrum([probe[name] / root.clamp(min=tiny) for probe in probes])
            for name, root in self.roots.items()
        }

    def product(self, vector: Tensor) -> Tensor:
        """About J^T W J times `vector`: D^(1/2) F^-1 c F D^(1/2), D being the diagonal."""
        parts = self.curvature.split(self.diagonal * vector)
        changes = self.curvature.split(vector)
        for name, root in self.roots.items():
            waves = torch.fft.rfftn(root * changes[name], dim=AXES) * self.spectra[name]
            parts[name] = root * torch.fft.irfftn(waves, root.shape[-3:], dim=AXES)
        return self.curvature.join(parts)

    def _probe(self, generator: torch.Generator) -> Tensor:
        images = self.curvature.images
        signs = {
            name: weight.sqrt() * normal_like(images[name], generator).sign()
            for name, weight in self.curvature.weights.items()
        }
        return self.curvature.adjoint(signs)


def _find_spectrum(fields: list[Tensor]) -> Tensor:
    """The mean power of `fields` [..., z, y, x] at each wave, and at those beside it."""
    power = torch.stack([torch.fft.fftn(field, dim=AXES).abs().square() for field in fields])
    power = power.mean(0)
    for axis in AXES:
        power = (power.roll(1, axis) + power + power.roll(-1, axis)) / 3
    cells = power.shape[-3] * power.shape[-2] * power.shape[-1]
    return power[..., : power.shape[-1] // 2 + 1] / cells
