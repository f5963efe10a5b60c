"""Iterations of the diffusion solver from zero, on real media.

    python benchmarks/solver.py [--device cuda] [--cells 32 64 128] [--tolerances 1e-3 1e-6]

`--cells`: edges of cubes, measured beside 64 x 96 x 64; three colors, float32. The plume is
`data/plume/density.npz` under its light; `--densities FILE...` adds other volumes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ddrecon.diffusion.closures import Closure
from ddrecon.diffusion.conservative import DiffusionProblem
from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solve import solve_by_multigrid
from ddrecon.grid import Grid
from ddrecon.io.volumes.table import read_field
from ddrecon.light.lights import DirectionalLight
from ddrecon.light.reduced import receive_light
from ddrecon.medium.coefficients import Volume, scale_medium

PLUME = Path(__file__).parents[1] / "data/plume/density.npz"


def system(density: Tensor, sigma_t: float, device: str) -> tuple[Operator, Tensor]:
    """The operator and the source of beams in `density` [z, y, x], albedo 0.999, 0.9 and 0.8, g
    0.3, in a box of side 1 along x.
    """
    depth, height, width = density.shape
    half = (depth / width / 2, height / width / 2, 0.5)
    grid = Grid((depth, height, width), (-half[0], -half[1], -half[2]), half)
    albedo = torch.tensor([0.999, 0.9, 0.8], device=device)
    volume = Volume(
        grid,
        density.to(device),
        sigma_t * (1 - albedo),
        sigma_t * albedo,
        torch.tensor(0.3, device=device),
    )
    medium = scale_medium(volume)
    light = DirectionalLight(
        torch.tensor([-2.0, -2.0, -1.0], device=device), torch.full((3,), 3.14, device=device)
    )
    source = receive_light(medium, [light], 1).source
    outside = torch.zeros(1, 1, 1, 1, device=device)
    problem = DiffusionProblem(
        medium,
        Closure("geometric", grid),
        source,
        outside,
        True,
    )
    with torch.no_grad():
        return problem.system


def resample(density: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """`density` [z, y, x] on `shape` cells."""
    return interpolate(density[None, None], size=shape, mode="trilinear")[0, 0]


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--cells", type=int, nargs="*", default=[32, 64, 128])
    parser.add_argument("--tolerances", type=float, nargs="*", default=[1e-3, 1e-6])
    parser.add_argument("--densities", type=Path, nargs="*", default=[])
    arguments = parser.parse_args()
    torch.set_num_threads(2)
    print("| medium, cells, tolerance | iterations |\n|---|---|")
    files = {"plume": PLUME} | {path.stem: path for path in arguments.densities}
    media = {
        name: torch.from_numpy(read_field(path, "density").values) for name, path in files.items()
    }
    for shape in [(n, n, n) for n in arguments.cells] + [(64, 96, 64)]:
        fields = {name: (resample(values, shape), 40.0) for name, values in media.items()} | {
            "nearly empty": (torch.full(shape, 1e-3), 12.0)
        }
        cells = " x ".join(map(str, shape))
        for name, (density, sigma_t) in fields.items():
            operator, source = system(density, sigma_t, arguments.device)
            for tolerance in arguments.tolerances:
                iterations = solve_by_multigrid(operator, source, None, tolerance).iterations
                print(f"| {name}, {cells}, {tolerance:.0e} | {iterations} |", flush=True)


if __name__ == "__main__":
    main()
