"""The participating medium: cross sections times density, and what delta-Eddington scaling makes of them.

Colors are the leading axis, of size 1 (gray) or 3. A coefficient is kept as `scale * field` so that constant cross sections
need only one field, the density, to be marched through, whatever the number of colors.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.phase import forward_fraction, scaled_mean_cosine


@dataclass(eq=False)
class Volume:
    """What a user describes: `density` [z, y, x] >= 0 and cross sections per unit density, on a grid.

    `sigma_a`, `sigma_s`: absorption and scattering [1/u], >= 0, each `[C]` or per cell `[C, z, y, x]` with C = 1 or 3;
    `g`: mean cosine of scattering, scalar in (-1, 1). Tensors may be replaced or require gradients.
    """

    grid: Grid
    density: Tensor
    sigma_a: Tensor
    sigma_s: Tensor
    g: Tensor

    def __post_init__(self) -> None:
        if tuple(self.density.shape) != self.grid.shape:
            raise ValueError(f"density is {tuple(self.density.shape)} but the grid has {self.grid.shape} cells [z, y, x]")


@dataclass(frozen=True)
class Coefficient:
    """A coefficient [1/u]: `scale` [C, 1, 1, 1] times `field` [K, z, y, x] with K = 1 or C."""

    scale: Tensor
    field: Tensor

    @property
    def value(self) -> Tensor:
        """The coefficient itself, `[C, z, y, x]`."""
        return self.scale * self.field


@dataclass(frozen=True)
class Medium:
    """Coefficients of one medium: `extinction` and `scattering` for beams, and what diffusion needs.

    `unscaled_extinction` is kappa_t itself; `extinction` and `diffuse_scattering` are those of the delta-Eddington scaled
    medium, `mean_cosine` its g'; `scattering` is the unscaled kappa_s, for single scattering with the exact phase function.
    """

    grid: Grid
    extinction: Coefficient
    unscaled_extinction: Coefficient
    scattering: Coefficient
    diffuse_scattering: Coefficient
    absorption: Coefficient
    g: Tensor
    mean_cosine: Tensor

    @property
    def transport_extinction(self) -> Tensor:
        """kappa_tr = kappa_a + (1 - g) kappa_s [1/u], `[C, z, y, x]`; delta-Eddington scaling leaves it unchanged."""
        return self.absorption.value + (1 - self.mean_cosine) * self.diffuse_scattering.value


def medium_of(volume: Volume) -> Medium:
    """The medium of `volume`: kappa = rho sigma, with kappa_s' = (1 - f) kappa_s and g' (THEORY section 5)."""
    sigma_a, sigma_s = _broadcast(volume.sigma_a), _broadcast(volume.sigma_s)
    scaled = (1 - forward_fraction(volume.g)) * sigma_s
    density = volume.density[None]

    def coefficient(sigma: Tensor) -> Coefficient:
        if sigma.shape[1:].numel() == 1:
            return Coefficient(sigma, density)
        return Coefficient(torch.ones_like(sigma[:, :1, :1, :1]), sigma * density)

    return Medium(
        volume.grid,
        extinction=coefficient(sigma_a + scaled),
        unscaled_extinction=coefficient(sigma_a + sigma_s),
        scattering=coefficient(sigma_s),
        diffuse_scattering=coefficient(scaled),
        absorption=coefficient(sigma_a),
        g=volume.g,
        mean_cosine=scaled_mean_cosine(volume.g),
    )


def _broadcast(sigma: Tensor) -> Tensor:
    return sigma if sigma.ndim == 4 else sigma.view(-1, 1, 1, 1)
