"""The participating medium: cross sections times density, with or without delta-Eddington scaling.

Colors are the leading axis, of size 1 (gray) or 3. A coefficient is kept as `scale * field`: where
cross sections are constant, rays need march through one field only, the density, for all colors.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.numerics.autodiff import is_varied
from ddrecon.numerics.decay import decay_mean
from ddrecon.numerics.remember import is_any_nonzero, remember


@dataclass(eq=False)
class Volume:
    """What a user describes: density, and cross sections per unit density, on a `grid`.

    `density`: [z, y, x], >= 0; `sigma_a`, `sigma_s`: absorption and scattering [1/u], >= 0, each
    [C] or per cell [C, z, y, x] with C = 1 or 3; `g`: mean cosine of scattering, scalar in (-1, 1).
    Tensors may be replaced or require gradients. Raises ValueError where shapes disagree.
    """

    grid: Grid
    density: Tensor
    sigma_a: Tensor
    sigma_s: Tensor
    g: Tensor

    def __post_init__(self) -> None:
        if tuple(self.density.shape) != self.grid.shape:
            raise ValueError(
                f"density is {tuple(self.density.shape)} but the grid has {self.grid.shape} "
                "cells [z, y, x]"
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
        """1 over the most by which third-order corrections may change an integral of `field`.

        That is half an optical depth, in the mean over colors.
        """
        return _mass_bound(self.scale)

    def mean_transmittance(self, entered: Tensor, step: Tensor) -> Tensor:
        """exp(-depth) averaged over each cell, `[C, z, y, x]`.

        `entered` [K, z, y, x]: the integral of `field` up to where light enters the cell; `step`:
        the light's path through the cell [u], scalar or [z, y, x].
        """
        return torch.exp(-self.scale * entered) * decay_mean(self.scale * (self.field * step))


@dataclass(frozen=True)
class Medium:
    """Coefficients of a medium of whose scattering the part f counts as not scattered.

    f is `forward_fraction`, the forward peak's. `absorption` is kappa_a. `scattering` is all of
    kappa_s, by which beams scatter with the exact phase function of mean cosine `g`. `extinction`
    is kappa_a + (1 - f) kappa_s, and `mean_cosine` the g' of the scattering that remains. `peak` is
    f kappa_s per unit of the extinction's field: times a mass, it is the depth x of E13. It is
    [C, 1, 1, 1], or [C, z, y, x] where cross sections vary, and None without a peak.
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
        """kappa_tr = kappa_a + (1 - g) kappa_s [1/u], `[C, z, y, x]`.

        Delta-Eddington scaling leaves it unchanged.
        """
        return self.absorption.value + (1 - self.g) * self.scattering.value

    @property
    def has_flux(self) -> bool:
        """Whether light's direction matters to scattering: g is not 0, or is being varied."""
        return is_varied(self.g) or is_any_nonzero(self.g)


def scale_medium(volume: Volume, degree: int = 1) -> Medium:
    """The delta-Eddington scaled medium of `volume`, by which the whole image is rendered.

    f and g' are `forward_fraction` and `scaled_mean_cosine` of `phase.py`, where the source is.
    """
    return _medium(volume, *_scale_phase(volume.g, degree))


def keep_medium(volume: Volume) -> Medium:
    """The medium of `volume` as it is, with f = 0.

    Path tracing separates single from multiple scattering by it.
    """
    return _medium(volume, torch.zeros_like(volume.g), volume.g)


def _medium(volume: Volume, fraction: Tensor, mean_cosine: Tensor) -> Medium:
    sigma_a, sigma_s = _broadcast(volume.sigma_a), _broadcast(volume.sigma_s)
    density = volume.density[None]

    def coefficient(sigma: Tensor) -> Coefficient:
        if sigma.shape[1:].numel() == 1:
            return Coefficient(sigma, density)
        return Coefficient(torch.ones_like(sigma[:, :1, :1, :1]), sigma * density)

    extinction, peak = _extinction_and_peak(sigma_a, sigma_s, fraction)
    return Medium(
        volume.grid,
        extinction=coefficient(extinction),
        scattering=coefficient(sigma_s),
        absorption=coefficient(sigma_a),
        g=volume.g,
        mean_cosine=mean_cosine,
        forward_fraction=fraction,
        peak=peak,
    )


@remember
def _mass_bound(scale: Tensor) -> Tensor:
    return 2 * scale.mean()


@remember
def _scale_phase(g: Tensor, degree: int) -> tuple[Tensor, Tensor]:
    f = g.clamp(min=0) ** (degree + 1)
    return f, (g - f) / (1 - f)


def _extinction_and_peak(
    sigma_a: Tensor, sigma_s: Tensor, fraction: Tensor
) -> tuple[Tensor, Tensor | None]:
    """kappa_a + (1 - f) kappa_s per unit density, and what `Medium` has as `peak`."""
    has_peak = is_any_nonzero(fraction)
    is_small = max(sigma_a[0].numel(), sigma_s[0].numel()) == 1
    find = _remember_scaled if is_small else _find_scaled
    return find(sigma_a, sigma_s, fraction, has_peak)


def _find_scaled(
    sigma_a: Tensor, sigma_s: Tensor, fraction: Tensor, has_peak: bool
) -> tuple[Tensor, Tensor | None]:
    extinction = sigma_a + (1 - fraction) * sigma_s
    return extinction, _peak_per_mass(extinction, fraction * sigma_s) if has_peak else None


_remember_scaled = remember(_find_scaled)


def _peak_per_mass(extinction: Tensor, forward: Tensor) -> Tensor:
    """`forward` scattering per unit of what is summed as mass.

    That is density, or `extinction` where that varies; 0 where there is none.
    """
    extinction, forward = torch.broadcast_tensors(extinction, forward)
    if extinction.shape[1:].numel() == 1:
        return forward
    return torch.where(extinction > 0, forward / torch.where(extinction > 0, extinction, 1), 0)


def _broadcast(sigma: Tensor) -> Tensor:
    return sigma if sigma.ndim == 4 else along_colors(sigma)


@remember
def along_colors(sigma: Tensor) -> Tensor:
    """Numbers of each color [C] as `[C, 1, 1, 1]`."""
    # A tensor of its own, not a view: what depends on it is remembered as well.
    return sigma.view(-1, 1, 1, 1) + 0
