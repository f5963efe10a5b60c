"""Iterations and time of each diffusion solver, to the same residual from the same zero start, on
real media; ratios are to multigrid.

    python benchmarks/solver.py [--device cuda] [--cells 32 64 128] [--tolerances 1e-3 1e-6]
                                [--jacobi]

`--cells`: edges of cubes, measured beside 64 x 96 x 64; three colors, float32. The plume is
`data/plume/density.npz` under its light; `--densities FILE...` adds other volumes. Solvers run in
turns, as often as `--repeats` says, and the median of the turns' ratios counts. Multigrid's time
includes making its grids; an adjoint solve finds them made. On a CPU, time is that of the
processor, which others on the machine disturb less.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ddrecon.diffusion.closures import Closure
from ddrecon.diffusion.conservative import DiffusionProblem
from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solvers import SOLVERS
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


def seconds(solver: str, operator: Operator, source: Tensor, tolerance: float) -> tuple[float, int]:
    """Time of a solve with nothing prepared, and its iterations."""
    fresh = Operator(operator.conductances, operator.loss)
    clock = time.perf_counter if source.is_cuda else time.process_time
    start = clock()
    iterations = SOLVERS[solver](fresh, source, None, tolerance).iterations
    return clock() - start, iterations


def row(
    name: str,
    operator: Operator,
    source: Tensor,
    tolerance: float,
    solvers: list[str],
    repeats: int,
) -> str:
    """One line of the table."""
    turns = [
        {solver: seconds(solver, operator, source, tolerance) for solver in solvers}
        for _ in range(repeats)
    ]
    cells = " x ".join(str(n) for n in source.shape[1:])
    columns = [str(turns[0][solver][1]) for solver in solvers]
    for solver in solvers[1:]:
        columns.append(
            f"{statistics.median(turn[solver][0] / turn['multigrid'][0] for turn in turns):.1f}"
        )
    return f"| {name}, {cells}, {tolerance:.0e} | {' | '.join(columns)} |"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--cells", type=int, nargs="*", default=[32, 64, 128])
    parser.add_argument("--tolerances", type=float, nargs="*", default=[1e-3, 1e-6])
    parser.add_argument("--densities", type=Path, nargs="*", default=[])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--jacobi", action="store_true", help="Jacobi iteration too (minutes)")
    arguments = parser.parse_args()
    torch.set_num_threads(2)
    solvers = ["multigrid", "conjugate_gradient", *(["jacobi"] if arguments.jacobi else [])]
    heads = [f"{solver}: iterations" for solver in solvers] + [
        f"time of {solver} / multigrid" for solver in solvers[1:]
    ]
    print(f"| medium, cells, tolerance | {' | '.join(heads)} |\n|{'---|' * (len(heads) + 1)}")
    files = {"plume": PLUME} | {path.stem: path for path in arguments.densities}
    media = {
        name: torch.from_numpy(read_field(path, "density").values) for name, path in files.items()
    }
    shapes = [(n, n, n) for n in arguments.cells] + [(64, 96, 64)]
    for shape in shapes:
        fields = {name: (resample(values, shape), 40.0) for name, values in media.items()} | {
            "nearly empty": (torch.full(shape, 1e-3), 12.0)
        }
        for name, (density, sigma_t) in fields.items():
            operator, source = system(density, sigma_t, arguments.device)
            for tolerance in arguments.tolerances:
                print(
                    row(name, operator, source, tolerance, solvers, arguments.repeats), flush=True
                )


if __name__ == "__main__":
    main()
