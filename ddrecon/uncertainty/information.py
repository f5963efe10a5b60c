"""What pictures say of all cells, roughly: J^T W J as a scale of each cell and one spectrum (E38).

Pictures tell sums along rays: smooth changes of a field far better than rough ones. The diagonal of
J^T W J does not know that. How it hangs together is nearly the same everywhere, but for its scale,
and a few random pictures show both. Products are cheap, so that equations can be solved with it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.numerics.around import mean_around
from ddrecon.reconstruct.curvature import Curvature
from ddrecon.uncertainty.prior import normal_like

PROBES = 3
"""Random pictures that it is found by."""
AXES = (-3, -2, -1)


class Information:
    """About J^T W J of `curvature`: its `diagonal` [n], and of each field a spectrum.

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
        self.spectra = {
            name: _find_spectrum([_over(probe[name], self.roots[name]) for probe in probes])
            for name in fields
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
        """J^T W^(1/2) times random signs."""
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


def _over(field: Tensor, root: Tensor) -> Tensor:
    """`field` over `root`; 0 where that is."""
    return torch.where(root > 0, field / root.clamp(min=torch.finfo(root.dtype).tiny), 0)
