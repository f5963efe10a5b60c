"""Times one application of the diffusion operator by slicing and by conv3d with fixed difference
kernels, and compares their results.

    python benchmarks/stencil.py [--device cuda]

Grid 64 x 96 x 64, three colors, float32. The ratio is what counts: both run in turns in one
process.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import conv3d, conv_transpose3d, pad

from ddrecon.diffusion.operator import AXES, Operator

SHAPE = (3, 64, 96, 64)


def difference_kernels(device: str) -> Tensor:
    """Three 2-point difference kernels, `[3, 1, 2, 2, 2]`: G along z, y, x."""
    kernels = torch.zeros(3, 1, 2, 2, 2, device=device)
    kernels[:, 0, 0, 0, 0] = -1
    kernels[0, 0, 1, 0, 0] = kernels[1, 0, 0, 1, 0] = kernels[2, 0, 0, 0, 1] = 1
    return kernels


def by_convolution(operator: Operator) -> Callable[[Tensor], Tensor]:
    """u -> G^T c G u + loss u with G as conv3d and G^T as its transpose; conductances are zero
    across the box's faces.
    """
    kernels = difference_kernels(str(operator.loss.device))
    padded = [
        pad(c, [0] * (2 * (3 - axis)) + [0, 1])
        for axis, c in zip(AXES, operator.conductances, strict=True)
    ]
    conductances = torch.stack(padded, 1)

    def apply(u: Tensor) -> Tensor:
        differences = conv3d(pad(u[:, None], (0, 1) * 3), kernels)
        back = conv_transpose3d(conductances * differences, kernels)[:, 0]
        return back[:, : u.shape[1], : u.shape[2], : u.shape[3]] + operator.loss * u

    return apply


def seconds(function: Callable[[Tensor], Tensor], u: Tensor) -> float:
    """Wall time of one call."""
    if u.is_cuda:
        torch.cuda.synchronize()
    start = time.perf_counter()
    function(u)
    if u.is_cuda:
        torch.cuda.synchronize()
    return time.perf_counter() - start


def main() -> None:
    """Prints medians, ratio and largest difference."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--device", default="cpu")
    device = parser.parse_args().device
    torch.manual_seed(0)
    faces = [
        torch.rand([n - (axis == d) for d, n in enumerate(SHAPE)], device=device) for axis in AXES
    ]
    operator = Operator((faces[0], faces[1], faces[2]), torch.rand(SHAPE, device=device))
    u = torch.rand(SHAPE, device=device)
    convolve = by_convolution(operator)
    print(
        f"largest difference {float((operator.apply(u) - convolve(u)).abs().max()):.1e} of {float(operator.apply(u).abs().max()):.1f}"
    )
    times = [(seconds(operator.apply, u), seconds(convolve, u)) for _ in range(20)]
    slicing, convolution = (statistics.median(column) for column in zip(*times, strict=True))
    print(
        f"slicing {1e3 * slicing:.2f} ms, conv3d {1e3 * convolution:.2f} ms, ratio {convolution / slicing:.1f}"
    )


if __name__ == "__main__":
    main()
