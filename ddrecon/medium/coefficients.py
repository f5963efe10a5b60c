"""The participating medium: cross sections times density, and what delta-Eddington scaling makes of
them.

Colors are the leading axis, of size 1 (gray) or 3. A coefficient is kept as `scale * field` so that
constant cross sections need only one field, the density, to be marched through, whatever the number
of colors.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.medium.phase import forward_fraction, scaled_mean_cosine
from ddrecon.numerics.autodiff import is_varied
from ddrecon.numerics.decay import decay_mean


@dataclass(eq=False)
class Volume:
    """What a user describes: `density` [z, y, x] >= 0 and cross sections per unit density, on a
    grid.

    `sigma_a`, `sigma_s`: absorption and scattering [1/u], >= 0, each `[C]` or per cell `[C, z, y,
    x]` with C = 1 or 3; `g`: mean cosine of scattering, scalar in (-1, 1). Tensors may be replaced
    or require gradients.
    """

    grid: Grid
    density: Tensor
    sigma_a: Tensor
    sigma_s: Tensor
    g: Tensor

    def __post_init__(self) -> None:
        if tuple(self.density.shape) != self.grid.shape:
            raise ValueError(
                f"density is {tuple(self.density.shape)} but the grid has {self.grid.shape} cells [z, y, x]"
            )


@dataclass(frozen=True)
class Coefficient:
    """A coefficient [1/u]: `scale` [C, 1, 1, 1] times `field` [K, z, y, x] with K = 1 or C."""

    scale: Tensor
    field: Tensor

    @property
    def value(self) -> Tensor:
        """The coefficient itself, `[C, z, y, x]`."""
        return self.scale * self.field

    @property
    def mass_bound(self) -> Tensor:
        """The inverse of the most that third-order interpolation may change an integral of `field`
        by: half an optical depth.
        """
        return 2 * self.scale.mean()

    def mean_transmittance(self, entered: Tensor, step: Tensor) -> Tensor:
        """exp(-depth) averaged over each cell, `[C, z, y, x]`.

        The light has `entered` mass behind it (the integral of `field`, [K, z, y, x]); `step`: what
        it crosses [u], scalar or [z, y, x].
        """
        return torch.exp(-self.scale * entered) * decay_mean(self.scale * (self.field * step))


@dataclass(frozen=True)
class Medium:
    """Coefficients of one medium, seen with the part `forward_fraction` f of its scattering taken
    as not scattered.

    `scattering` is kappa_s itself, which beams scatter by with the exact phase function of mean
    cosine `g`; `extinction` is kappa_a + (1 - f) kappa_s, and `mean_cosine` the g' of the
    scattering that remains. `peak` times the integral of the extinction's field is the depth f
    kappa_s of the forward peak: `[C, 1, 1, 1]`, `[C, z, y, x]` where cross sections vary, None
    without a peak.
    """

    grid: Grid
    extinction: Coefficient
    scattering: Coefficient
    absorption: Coefficient
    g: Tensor
    mean_cosine: Tensor
    forward_fraction: Tensor
    peak: Tensor | None

    @property
    def remaining_scattering(self) -> Tensor:
        """(1 - f) kappa_s [1/u], `[C, z, y, x]`."""
        return (1 - self.forward_fraction) * self.scattering.value

    @property
    def transport_extinction(self) -> Tensor:
        """kappa_tr = kappa_a + (1 - g) kappa_s [1/u], `[C, z, y, x]`; delta-Eddington scaling
        leaves it unchanged.
        """
        return self.absorption.value + (1 - self.g) * self.scattering.value


def scale_medium(volume: Volume) -> Medium:
    """The delta-Eddington scaled medium of `volume`, which the whole image is rendered by
    (docs/theory.md, section 5).
    """
    return _medium(volume, forward_fraction(volume.g), scaled_mean_cosine(volume.g))


def keep_medium(volume: Volume) -> Medium:
    """The medium of `volume` as it is, by which path tracing separates single from multiple
    scattering.
    """
    return _medium(volume, torch.zeros_like(volume.g), volume.g)


def _medium(volume: Volume, fraction: Tensor, mean_cosine: Tensor) -> Medium:
    sigma_a, sigma_s = _broadcast(volume.sigma_a), _broadcast(volume.sigma_s)
    density = volume.density[None]

    def coefficient(sigma: Tensor) -> Coefficient:
        if sigma.shape[1:].numel() == 1:
            return Coefficient(sigma, density)
        return Coefficient(torch.ones_like(sigma[:, :1, :1, :1]), sigma * density)

    extinction = sigma_a + (1 - fraction) * sigma_s
    return Medium(
        volume.grid,
        extinction=coefficient(extinction),
        scattering=coefficient(sigma_s),
        absorption=coefficient(sigma_a),
        g=volume.g,
        mean_cosine=mean_cosine,
        forward_fraction=fraction,
        peak=_peak(extinction, fraction * sigma_s) if bool(fraction > 0) else None,
    )


def _peak(extinction: Tensor, forward: Tensor) -> Tensor:
    """`forward` scattering per unit of what is summed as mass: density, or `extinction` where that
    varies (0 where there is none).
    """
    extinction, forward = torch.broadcast_tensors(extinction, forward)
    if extinction.shape[1:].numel() == 1:
        return forward
    return torch.where(extinction > 0, forward / torch.where(extinction > 0, extinction, 1), 0)


def _broadcast(sigma: Tensor) -> Tensor:
    return sigma if sigma.ndim == 4 else sigma.view(-1, 1, 1, 1)


def has_flux(medium: Medium) -> bool:
    """Whether light's direction matters to scattering: g is not 0, or is being differentiated."""
    return is_varied(medium.g) or bool(medium.g.detach() != 0)
