"""Times one iteration of configs/plume.yaml at full resolution (render of ten views, and its
derivative), with the error it comes with.

    python benchmarks/gradient.py [--device cuda] [--repeat 5]

Everything is at the true density: the PSNR printed is that of our render against the path-traced
pictures, and so measures the model.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import torch

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.losses import image_loss, psnr
from ddrecon.renderer import render_each
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene

ROOT = Path(__file__).parents[1]


def now(device: str) -> float:
    """The time, once the device has done what it was given."""
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def iteration(scene: Scene, device: str, is_warm: bool, memory: SolveMemory) -> tuple[float, float]:
    """Seconds of the render and of its derivative."""
    if not is_warm:
        memory.last.clear()
    scene.volume.density = scene.volume.density.detach().requires_grad_()
    start = now(device)
    images = render_each(scene, scene.views, memory)
    middle = now(device)
    torch.stack(
        [
            image_loss("l2", image, view.image, None)
            for image, view in zip(images, scene.views, strict=True)
        ]
    ).mean().backward()
    return middle - start, now(device) - middle


def main() -> None:
    """Prints medians for cold and warm solves."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeat", type=int, default=5)
    args = parser.parse_args()
    overrides = [
        f"volume.density={{file: {ROOT / 'data/plume/density.npz'}}}",
        "optimize.parameters.density={}",
    ]
    scene = load_scene(ROOT / "configs/plume.yaml", overrides=overrides, device=args.device)
    scene.views = [view for view in scene.views if not view.is_test]
    for is_warm in (False, True):
        memory = SolveMemory()
        iteration(scene, args.device, is_warm, memory)
        memory.records.clear()
        times = [iteration(scene, args.device, is_warm, memory) for _ in range(args.repeat)]
        render, derivative = (statistics.median(column) for column in zip(*times, strict=True))
        solves = ", ".join(
            f"{r.kind} {r.iterations} iterations {r.seconds:.3f} s" for r in memory.records[-2:]
        )
        print(
            f"{'warm' if is_warm else 'cold'}: render {render:.3f} s, derivative {derivative:.3f} s ({solves})"
        )
    with torch.no_grad():
        images = render_each(scene, scene.views, SolveMemory())
    values = [
        psnr(image, view.image, None) for image, view in zip(images, scene.views, strict=True)
    ]
    print(f"PSNR against path tracing at the true density: {sum(values) / len(values):.2f} dB")
    print(f"{args.device}, {torch.get_num_threads()} threads, torch {torch.__version__}")


if __name__ == "__main__":
    main()
