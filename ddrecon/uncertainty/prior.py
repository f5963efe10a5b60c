"""What a run assumes of its parameters before it looks at pictures, as a Gaussian: R + T K (E11.4).

R is its smoothing (E11.2). K makes it proper, where smoothing says nothing: how bright a whole
field is, and what single numbers are. It is so weak that it counts only where pictures say nothing.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solvers import SOLVERS
from ddrecon.reconstruct.curvature import Curvature
from ddrecon.reconstruct.numbers import calibration_prior
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.roughness import AXES, Roughness
from ddrecon.scene import Scene

WIDE = 10.0
"""A number may be off by so many times itself, or by so many hundred steps of its optimizer."""
STEPS = 100.0
SOLVE = 1e-4
"""Relative residual of a draw from the prior."""
DIAGONAL = 1e-2
"""And of the solves that conjugate gradients are preconditioned with."""


class Prior:
    """R + `temperature` K of the parameters of `curvature`, whose vectors it takes and gives."""

    def __init__(self, curvature: Curvature, temperature: float):
        self.curvature = curvature
        self.precision = {
            p.name: temperature * _precision_of(p, curvature.scene, p.name in curvature.roughness)
            for p in curvature.parameters
        }

    def product(self, vector: Tensor) -> Tensor:
        """(R + T K) times `vector`."""
        parts = self.curvature.split(vector)
        weak = {name: _times(precision, parts[name]) for name, precision in self.precision.items()}
        return self.curvature.penalty_product(vector) + self.curvature.join(weak)

    def root_noise(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Two random vectors, the covariance of whose sum is R + T K.

        The second is what single numbers and levels of smoothed fields come of, the first all else.
        """
        parts, levels = dict[str, Tensor](), dict[str, Tensor]()
        fields = {parameter.name for parameter in self.curvature.parameters if parameter.is_field}
        for name, value in self.curvature.values.items():
            precision = self.precision[name]
            root = torch.linalg.cholesky(precision) if precision.ndim == 2 else precision.sqrt()
            weak = _times(root, normal_like(value, generator))
            if (roughness := self.curvature.roughness.get(name)) is not None:
                noises = [normal_like(value, generator) for _ in AXES]
                parts[name] = roughness.root_product(noises)
            # What is constrained so weakly is far off in a draw: pictures alone say where it is.
            has_draw = name in fields and roughness is None
            (parts if has_draw else levels)[name] = weak
        return self.curvature.join(parts), self.curvature.join(levels)

    def solve(
        self,
        right: Tensor,
        is_fixed: Tensor | None = None,
        more: Tensor | None = None,
        tolerance: float = SOLVE,
    ) -> Tensor:
        """(R + T K + diag(`more`))^-1 times `right`, with 0 where `is_fixed`."""
        fixed = torch.zeros_like(right).bool() if is_fixed is None else is_fixed
        is_fixed_of = self.curvature.split(fixed)
        added = self.curvature.split(torch.zeros_like(right) if more is None else more)
        parts = {}
        for name, part in self.curvature.split(right).items():
            precision, roughness = self.precision[name], self.curvature.roughness.get(name)
            part = part.masked_fill(is_fixed_of[name], 0)
            if precision.ndim == 2:
                solved = torch.linalg.solve(precision + added[name].diag(), part)
            elif roughness is None:
                solved = part / (precision + added[name])
            else:
                diagonal = precision + added[name]
                # Levels of smoothed fields are constrained so weakly that a draw needs more digits.
                if more is None:
                    stiffness = roughness.stiffness.double()
                    roughness, diagonal = Roughness(roughness.grid, stiffness), diagonal.double()
                exact = part.to(roughness.stiffness)
                solved = _solve_field(roughness, diagonal, exact, is_fixed_of[name], tolerance)
            parts[name] = solved.to(part).masked_fill(is_fixed_of[name], 0)
        return self.curvature.join(parts)

    def without_levels(self, vector: Tensor, is_fixed: Tensor) -> Tensor:
        """`vector` less the mean of each smoothed field over cells that are not fixed."""
        parts, fixed = self.curvature.split(vector), self.curvature.split(is_fixed)
        for name in self.curvature.roughness:
            free = (~fixed[name]).to(vector)
            cells = free.sum((-3, -2, -1), keepdim=True).clamp(min=1)
            level = (parts[name] * free).sum((-3, -2, -1), keepdim=True) / cells
            parts[name] = parts[name] - level * free
        return self.curvature.join(parts)


def normal_like(value: Tensor, generator: torch.Generator) -> Tensor:
    """Independent standard normal numbers of the shape, precision and device of `value`."""
    noise = torch.randn(value.shape, generator=generator, dtype=value.dtype)
    return noise.to(value.device)


def _precision_of(parameter: Parameter, scene: Scene, is_smoothed: bool) -> Tensor:
    """K of `parameter`: a number for all its entries, or the matrix [6, 6] of a camera.

    A smoothed field may be brighter or darker, as a whole, by its root mean square; without
    smoothing each cell may be, by itself. Cameras err as a calibration does (E10.3).
    """
    value = parameter.value.detach()
    if parameter.key == "camera" and parameter.view is not None:
        camera = scene.view(parameter.view).camera
        return calibration_prior(camera, scene.volume.grid).to(value)
    if parameter.is_field:
        inside = value[value.abs() > rounding_of(parameter)]
        square = inside.square().mean() if len(inside) else value.new_tensor(parameter.unit**2)
        return 1 / (square * (value.numel() if is_smoothed else 1))
    largest = WIDE * value.abs().max() + STEPS * parameter.largest_rate
    return 1 / largest**2


def rounding_of(parameter: Parameter) -> float:
    """What is as good as 0 among values of `parameter`: rounding of its steps."""
    return torch.finfo(parameter.value.dtype).eps * parameter.largest_rate


def _times(precision: Tensor, part: Tensor) -> Tensor:
    return precision @ part if precision.ndim == 2 else precision * part


def _solve_field(
    roughness: Roughness, diagonal: Tensor, right: Tensor, is_fixed: Tensor, tolerance: float
) -> Tensor:
    """(R + `diagonal`)^-1 `right` of a field, with 0 in cells that are fixed, by multigrid."""
    colors, size = right.reshape(-1, *right.shape[-3:]), float(right.abs().max())
    if not size:
        return right
    # In units where numbers are near 1: squares of residuals would leave float32.
    unit = float((roughness.diagonal() + diagonal).max())
    roughness, diagonal, colors = roughness.times(1 / unit), diagonal / unit, colors / size
    # No level is constrained so weakly that it is lost in rounding.
    diagonal = diagonal.clamp(min=10 * torch.finfo(right.dtype).eps)
    # Cells that are fixed lose so much that nothing is left in them.
    strong = 1e4 * (roughness.diagonal().max() + diagonal.max())
    loss = torch.where(is_fixed, strong, diagonal)
    # R has the form of the diffusion operator: stiffness is conductance between cells.
    z, y, x = (part.reshape(-1, *part.shape[-3:]) for part in roughness.conductances())
    operator = Operator((z, y, x), loss.reshape(colors.shape).contiguous())
    solved = SOLVERS["multigrid"](operator, colors, None, tolerance).value.view(right.shape)
    return solved * (size / unit)
