"""What one more scattering makes of light inside a medium: E3, towards a camera."""

from __future__ import annotations

from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import is_fused, recompute


def scatter_once_more(medium: Medium, light: Moments) -> Moments:
    """(1 - f) (L0 + g' L1.w) as moments, per unit length and kappa_s (E3).

    `light`: L0 and L1.
    """
    kept = 1 - medium.forward_fraction
    return light.scaled(kept, kept * medium.mean_cosine)


def scatter_towards(medium: Medium, light: Moments, rays: Rays) -> Tensor:
    """The radiance >= 0 `[C, z, y, x]` of `scatter_once_more` towards the camera of `rays`.

    As `Moments.positive_along` has it.
    """
    if is_fused() and medium.mean_cosine.ndim == 0:
        from ddrecon.light.fused.outgoing import scatter_fused

        return scatter_fused(medium, light, rays)
    return recompute(_scatter_towards, medium, light, rays)


def _scatter_towards(medium: Medium, light: Moments, rays: Rays) -> Tensor:
    return scatter_once_more(medium, light).positive_along(rays.towards_eye(medium.grid))
