"""An image of the plume and its gradient by every cell's density, beside Mitsuba's path replay
backpropagation.

    DRJIT_LIBLLVM_PATH=... python benchmarks/replay.py [--pixels 512] [--paths 4 16]

Needs Mitsuba 3 (extra `reference`) and its variant `llvm_ad_rgb`. Times are of this run only, on as
many threads for both. Gradients are compared as sums of density times gradient over blocks of 4^3
cells, each with that of the most paths.
"""

from __future__ import annotations

import argparse
import statistics

import torch

from ddrecon.bench.measure import blocks_of, correlation, shoot
from ddrecon.bench.path_tracing import PathTracer
from ddrecon.bench.plume import plume_scene

REPEATS = 5


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--pixels", type=int, default=512)
    parser.add_argument("--cells", type=int, default=64)
    parser.add_argument("--paths", type=int, nargs="+", default=[4, 16])
    arguments = parser.parse_args()
    scene = plume_scene(arguments.cells, arguments.pixels, torch.float32, torch.device("cpu"))
    ours = [shoot(scene, blocks_of(scene)) for _ in range(REPEATS + 1)][1:]
    tracer = PathTracer(scene, has_gradient=True)
    if tracer.replay is None:
        raise SystemExit("path replay needs the variant llvm_ad_rgb: set DRJIT_LIBLLVM_PATH")
    tracer.shoot(1, seed=len(arguments.paths))
    theirs = [tracer.shoot(paths, seed) for seed, paths in enumerate(arguments.paths)]
    rows = {"ours": ours[0]} | {
        f"Mitsuba, {paths} paths a pixel": shot
        for paths, shot in zip(arguments.paths, theirs, strict=True)
    }
    seconds = {name: (shot.image_seconds, shot.gradient_seconds) for name, shot in rows.items()}
    seconds["ours"] = (
        statistics.median(s.image_seconds for s in ours),
        statistics.median(s.gradient_seconds for s in ours),
    )
    print("| | image s | gradient s | times ours | correlation |\n|---|---|---|---|---|")
    for name, shot in rows.items():
        image, gradient = seconds[name]
        found = correlation(shot.by_amount, theirs[-1].by_amount)
        print(
            f"| {name} | {image:.2f} | {gradient:.2f} | {(image + gradient) / sum(seconds['ours']):.0f} | {found:.3f} |"
        )


if __name__ == "__main__":
    main()
