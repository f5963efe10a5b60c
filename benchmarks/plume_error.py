"""What the error of the plume's density is made of: noise, what pictures leave open, smoothing, and
what our light lacks.

python benchmarks/plume_error.py

At a quarter of the resolution, from pictures of our own rendering (on the grid that is
reconstructed, or on the fine one) and from the path-traced ones.
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
from ddrecon.renderer import render
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene

ROOT = Path(__file__).parents[1]
FACTOR = 4
NOISE = 0.045 / FACTOR
"""That of the path-traced pictures, of their mean squares' root, in means of 4 x 4 pixels."""
CASES = [
    ("ours", "", 1, 0.0),
    ("ours", "", 1, 3e-4),
    ("ours", "", 1, 3e-3),
    ("ours", "noise", 1, 3e-3),
    ("path-traced", "noise", 1, 3e-3),
    ("ours, of the fine grid", "", 1, 3e-3),
    ("path-traced", "noise", 0, 3e-3),
    ("path-traced", "noise", 2, 3e-3),
    ("ours", "noise", 1, 3e-4),
]
"""Whose pictures, with noise or without, transport rounds, weight of smoothing."""


def with_pictures(scene: Scene, truth: Tensor, noise: float) -> Scene:
    """`scene` with pictures of the density `truth` by our own renderer."""
    images = render(replace(scene, volume=replace(scene.volume, density=truth)))
    generator, views = torch.Generator().manual_seed(1), []
    for view, image in zip(scene.views, images, strict=True):
        deviation = noise * image.square().mean().sqrt()
        random = torch.randn(image.shape, generator=generator)
        views.append(replace(view, image=image + deviation * random))
    return replace(scene, views=views)


def main() -> None:
    """Prints a row for each case."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--iterations", type=int, default=300)
    arguments = parser.parse_args()
    torch.manual_seed(0)
    fine_truth = torch.as_tensor(read_field(ROOT / "data/plume/density.npz", "density").values)
    print("| pictures | noise | rounds | tv | L1 | held-out PSNR [dB] |\n|---|---|---|---|---|---|")
    for whose, noise, rounds, tv in CASES:
        overrides = [
            f"diffusion.transport_rounds={rounds}",
            f"optimize.parameters.density.tv={tv}",
            "optimize.parameters.density.l1=0",
            f"optimize.iterations={arguments.iterations}",
        ]
        full = load_scene(ROOT / "configs/plume.yaml", overrides=overrides)
        if "fine" in whose:
            full = with_pictures(full, fine_truth, 0.0)
        scene = scene_at_level(full, FACTOR)
        truth = resample(fine_truth, scene.volume.grid)
        if whose == "ours":
            scene = with_pictures(scene, truth, NOISE if noise else 0.0)
        settings = replace(full.optimize, refine_at=())
        run = Reconstruction(
            replace(scene, optimize=settings, starts={"density": torch.zeros_like(truth)})
        )
        while not run.is_done:
            row = run.step()
        found = run.current_scene().volume.density
        error = float((found - truth).abs().sum() / truth.sum())
        shown = f"{whose} | {noise or 'none'} | {rounds} | {tv:g} | {error:.3f}"
        print(f"| {shown} | {row.test_psnr:.1f} |", flush=True)


if __name__ == "__main__":
    main()
