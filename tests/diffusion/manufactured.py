"""A solution of the diffusion equation in a medium that varies, made for tests of convergence."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

D_AT_FACES = 0.2
EXTENT = (1.0, 1.2, 0.8)


def manufactured(position: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """L0, D, kappa_a, kappa_s Q0, kappa_s Q1 and L1 at (z, y, x) that fulfill E2.4-E2.6.

    Along each axis L0 is 1 + t (L - t) / (2 D L), so that L0 / 2 = -D dL0/dn on both faces, where D
    is D_AT_FACES but not flat, and where Q1 runs along the face.
    """
    z, y, x = (axis.clone().requires_grad_() for axis in position)
    u, bump = torch.ones_like(z), torch.ones_like(z)
    for t, length in zip((z, y, x), EXTENT, strict=True):
        u = u * (1 + t * (length - t) / (2 * D_AT_FACES * length))
        bump = bump * torch.sin(math.pi * t / length)
    diffusion, absorption = D_AT_FACES * (1 + bump), 1 + torch.cos(z) * y
    slopes = torch.autograd.grad(u.sum(), (z, y, x), create_graph=True)
    flux, moved, injected = [], [], absorption * u
    for t, length, slope in zip((z, y, x), EXTENT, slopes, strict=True):
        flux.append(torch.sin(math.pi * t / length) * (1 + x * y))
        moved.append(diffusion * (flux[-1] - slope))
        injected = injected + torch.autograd.grad(moved[-1].sum(), t, retain_graph=True)[0]
    fields = [u, diffusion, absorption, injected, *flux, *(3 * component for component in moved)]
    return tuple(field.detach()[None] for field in fields)
