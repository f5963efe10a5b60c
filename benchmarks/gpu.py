"""A GPU's speed and memory in reconstructions, and whether it finds what a processor finds.

    python benchmarks/gpu.py [--device cuda] [--shrink 1]
    python benchmarks/gpu.py --compare [--device cuda]

The first reconstructs plumes of `ddrecon.bench.plume`, each from its own image at full resolution,
one view: the paper's size, its joint case, and as many cells as fit. `launches` are those of one
iteration, and `at work` the part of its time in which the device has something to do. `--shrink 8`
makes grids and images eight times smaller, to try the script where there is no GPU. The second
compares the scenes of `configs` in double precision, coarser, with torch's on the processor: how
far apart are the emission, the light's mean, images, and derivatives by what is optimized.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch
from scaling import start_run
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from ddrecon.bench.plume import plume_scene
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import ENGINES, use_engine
from ddrecon.reconstruct.gradients import differentiate
from ddrecon.reconstruct.levels import scene_at_level
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.renderer import solve_light
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import value_of, variable_names, with_values

CONFIGS = Path(__file__).parents[1] / "configs"
SMALL = "64 x 96 x 64, 512 x 512, density (the paper: 22.5 iterations a second on an RTX 2080 Ti)"
JOINT = (
    "168 x 252 x 168, 512 x 512, density, sigma_a and sigma_s in RGB: 49.8 million numbers "
    "(the paper: 8 s an iteration)"
)
LARGE = "448 x 672 x 448, 512 x 512, density"
CASES = {
    SMALL: (64, 512, False, 10),
    JOINT: (168, 512, True, 5),
    LARGE: (448, 512, False, 2),
}
"""Cells across, pixels across, whether colored fields are optimized too, and iterations."""
CELLS = 6000
"""Scenes are compared in at most about so many cells."""


def run_of(cells: int, pixels: int, is_joint: bool, device: torch.device) -> Reconstruction:
    """A reconstruction of a plume from its image, from half its density."""
    scene = plume_scene(cells, pixels, torch.float32, device)
    if not is_joint:
        return start_run(scene)
    volume, shape = scene.volume, (3, *scene.volume.grid.shape)
    colors = torch.tensor([1.0, 0.9, 0.7], device=device).view(3, 1, 1, 1)
    fields = {
        name: (getattr(volume, name) * colors).expand(shape).contiguous()
        for name in ("sigma_a", "sigma_s")
    }
    joint = replace(scene, volume=replace(volume, **fields))
    return start_run(joint, ("density", *fields))


def measure(run: Reconstruction, iterations: int, device: torch.device) -> str:
    """Cells of the table."""
    is_gpu = device.type == "cuda"
    if is_gpu:
        torch.cuda.reset_peak_memory_stats(device)
    run.step()
    start = now(device)
    for _ in range(iterations):
        run.step()
    seconds = (now(device) - start) / iterations
    peak, launches, work = "-", "-", "-"
    if is_gpu:
        peak = f"{torch.cuda.max_memory_allocated(device) / 2**30:.2f} GiB"
        with profile(activities=[ProfilerActivity.CUDA]) as seen:
            run.step()
            now(device)
        rows = seen.key_averages()
        launches = f"{sum(row.count for row in rows if 'LaunchKernel' in row.key):,}"
        work = f"{sum(row.self_device_time_total for row in rows) / 1e6 / seconds:.0%}"
    return f"{seconds:.4f} | {1 / seconds:.1f} | {peak} | {launches} | {work}"


def now(device: torch.device) -> float:
    """The time, once the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def find(path: Path, device: torch.device) -> dict[str, Tensor]:
    """What is compared of a scene file, by name, from densities drawn at random."""
    scene = load_scene(path, dtype=torch.float64, device=device)
    factor = max(1, round((scene.volume.grid.cells / CELLS) ** (1 / 3)))
    scene = scene_at_level(scene, factor)
    scene = replace(scene, views=scene.views[:2])
    sought = scene.optimize.parameters.keys() if scene.optimize else {"density"}
    values = {
        name: value_of(scene, name).detach()
        for name in sorted(sought)
        if name in variable_names(scene)
    }
    drawn = torch.rand(scene.volume.grid.shape, generator=torch.Generator().manual_seed(1))
    if "density" in values:
        values["density"] = (0.2 + 0.6 * drawn).to(values["density"])
    seen = with_values(scene, values)
    with torch.no_grad():
        light = solve_light(seen, SolveMemory())
    found = {"light": light.diffuse.mean}
    if light.medium.emission is not None:
        found["emission"] = light.medium.emission
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    names = [view.name for view in scene.views]
    torch.manual_seed(0)
    back = differentiate(
        scene, names, leaves, lambda _, image: image.square().mean(), SolveMemory()
    )
    found |= {f"image {name}": image for name, image in zip(names, back.images, strict=True)}
    return found | {f"d {name}": one for name, one in back.gradients.items()}


def compare(device: torch.device) -> Iterator[str]:
    """The rows of the table: how far each is from the processor's, and what is farthest."""
    for path in sorted([*CONFIGS.glob("*.yaml"), *CONFIGS.glob("kinds/*.yaml")]):
        use_engine("torch")
        known = find(path, torch.device("cpu"))
        for engine in ENGINES:
            use_engine(engine)
            errors = {
                name: float((one.cpu() - known[name]).norm() / known[name].norm().clamp(min=1e-300))
                for name, one in find(path, device).items()
            }
            far = max(errors, key=lambda name: errors[name])
            cells = path.stem, engine, f"{errors['light']:.0e}", f"{errors[far]:.0e}", far
            yield f"| {' | '.join(cells)} |"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--shrink", type=int, default=1)
    parser.add_argument("--compare", action="store_true")
    arguments = parser.parse_args()
    device = torch.device(arguments.device)
    print(
        f"{torch.cuda.get_device_name(device) if device.type == 'cuda' else 'CPU'}, torch "
        f"{torch.__version__}"
    )
    if arguments.compare:
        print("| scene | engine | light | farthest | of |\n|---|---|---|---|---|")
        for row in compare(device):
            print(row, flush=True)
        return
    print(
        "| case | engine | seconds an iteration | iterations a second | peak memory | launches "
        "| at work |\n|---|---|---|---|---|---|---|"
    )
    for name, (cells, pixels, is_joint, iterations) in CASES.items():
        for engine in reversed(ENGINES):
            use_engine(engine)
            run = run_of(cells // arguments.shrink, pixels // arguments.shrink, is_joint, device)
            print(f"| {name} | {engine} | {measure(run, iterations, device)} |", flush=True)


if __name__ == "__main__":
    main()
