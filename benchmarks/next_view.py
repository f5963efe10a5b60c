"""Does the picture that `ddrecon uncertainty --next-view ring` ranks first lower the error most?

python benchmarks/next_view.py

The plume at a quarter of its resolution, scattering evenly, is seen by three cameras on one side,
in pictures of our own rendering with noise. Twelve candidates are ranked; then each picture is
really taken, and the volume reconstructed with it.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from ddrecon.io.volumes.table import read_field
from ddrecon.reconstruct.levels import resample, scene_at_level
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.next_view import CANDIDATES, Candidate, NextView, shots_around
from ddrecon.reconstruct.uncertainty import Uncertainty
from ddrecon.renderer import render
from ddrecon.scene import Scene, View
from ddrecon.scene_file.build import load_scene
from ddrecon.settings import NoiseSettings

ROOT = Path(__file__).parents[1]
SEEN = 3


def photograph(scene: Scene, truth: Tensor, views: list[View], noise: float) -> list[View]:
    """`views` with pictures of the `truth` that err by `noise`, the same for the same name."""
    shown = replace(scene, volume=replace(scene.volume, density=truth), views=views)
    taken = []
    for view, image in zip(views, render(shown), strict=True):
        generator = torch.Generator().manual_seed(sum(view.name.encode()))
        taken.append(
            replace(view, image=image + noise * torch.randn(image.shape, generator=generator))
        )
    return taken


def reconstruct(scene: Scene, views: list[View]) -> Reconstruction:
    """A run of `scene` from these `views`, at its end."""
    run = Reconstruction(replace(scene, views=views))
    while not run.is_done:
        run.step()
    return run


def error_of(run: Reconstruction, truth: Tensor) -> float:
    """The relative L1 error of its density."""
    return float((run.current_scene().volume.density - truth).abs().sum() / truth.sum())


def rank_of(values: list[float]) -> Tensor:
    """The rank of each of `values`."""
    return torch.tensor(values).argsort().argsort().double()


def main() -> None:
    """Prints a row for each candidate, best first."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--noise", type=float, default=0.02, help="of radiance")
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--iterations", type=int, default=60)
    parser.add_argument("--tolerance", type=float, default=0.1, help="of samples")
    arguments = parser.parse_args()
    torch.manual_seed(0)
    full = load_scene(ROOT / "configs/plume.yaml", overrides=["volume.g=0"])
    true = torch.as_tensor(read_field(ROOT / "data/plume/density.npz", "density").values)
    scene = scene_at_level(full, 4)
    truth = resample(true, scene.volume.grid)
    settings = replace(
        full.optimize,
        iterations=arguments.iterations,
        refine_at=(),
        views_per_iteration=0,
        noise=NoiseSettings(read=arguments.noise),
    )
    scene = replace(scene, optimize=settings, starts={"density": torch.zeros_like(truth)})
    seen = photograph(scene, truth, scene.views[:SEEN], arguments.noise)
    run = reconstruct(scene, seen)
    print(f"{SEEN} pictures: L1 {error_of(run, truth):.4f}", flush=True)
    found = Uncertainty(run, run.seed, tolerance=arguments.tolerance)
    ring = shots_around(replace(scene, views=seen), "ring")
    ranking = NextView(found.curvature, ring, found.errors.deviation)
    for _ in range(arguments.samples):
        ranking.add(found.step().change)
    ranked: list[Candidate] = ranking.rank()
    print("| camera | gain, at least | error of it | L1 with its picture |\n|---|---|---|---|")
    errors = []
    for candidate in ranked:
        taken = photograph(scene, truth, [candidate.shot.view], arguments.noise)
        errors.append(error_of(reconstruct(scene, [*seen, *taken]), truth))
        gains = f"{100 * candidate.gain:.1f} % | {100 * candidate.error:.1f} %"
        print(f"| {candidate.shot.view.name} | {gains} | {errors[-1]:.4f} |", flush=True)
    orders = torch.stack([rank_of([-c.gain for c in ranked]), rank_of(errors)])
    agree = float(torch.corrcoef(orders)[0, 1])
    print(f"rank correlation {agree:.2f}; median L1 {sorted(errors)[CANDIDATES // 2]:.4f}")


if __name__ == "__main__":
    main()
