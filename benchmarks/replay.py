"""An image of the plume and its gradient by every cell's density, beside Mitsuba's path replay
backpropagation.

    DRJIT_LIBLLVM_PATH=... python benchmarks/replay.py [--pixels 512] [--paths 4 16]

Needs Mitsuba 3 (extra `reference`) and its variant `llvm_ad_rgb`. Times are of this run only, on as
many threads for both. Gradients are compared as sums of density times gradient over blocks of 4^3
cells, each with that of the most paths.
"""

from __future__ import annotations

import argparse
from statistics import median
from time import perf_counter

import torch
from path_replay import DENSITY, Replay, why_not
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool3d

from ddrecon.bench.measure import Shot, shoot
from ddrecon.bench.plume import plume_scene
from ddrecon.scene import Scene

REPEATS, BLOCK = 5, 4


def replay_shot(replay: Replay, scene: Scene, paths: int, seed: int) -> Shot:
    """The image and the gradient of its mean, by so many `paths` a pixel."""
    import drjit

    density = scene.volume.density
    start = perf_counter()
    image = torch.from_numpy(replay.image(seed, paths))
    middle = perf_counter()
    name = replay.name(DENSITY)
    _, (found,) = replay.gradients(lambda image: drjit.mean(image, axis=None), [name], seed, paths)
    gradient = replay.by_density(found, density)
    return Shot(image, gradient, middle - start, perf_counter() - middle, paths)


def by_amount(shot: Shot, density: Tensor) -> Tensor:
    """What changes as all density of a block grows by a factor; empty cells have no part in it."""
    blocks = [max(1, size // BLOCK) for size in density.shape]
    return adaptive_avg_pool3d((shot.gradient * density)[None], blocks).flatten().double()


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--pixels", type=int, default=512)
    parser.add_argument("--cells", type=int, default=64)
    parser.add_argument("--paths", type=int, nargs="+", default=[4, 16])
    given = parser.parse_args()
    if lacking := why_not():
        raise SystemExit(f"path replay {lacking}")
    scene = plume_scene(given.cells, given.pixels, torch.float32, torch.device("cpu"))
    replay = Replay.of(scene)
    rows = {"ours": [shoot(scene) for _ in range(REPEATS + 1)][1:]}
    replay_shot(replay, scene, 1, len(given.paths))  # compiles
    for seed, paths in enumerate(given.paths):
        rows[f"Mitsuba, {paths} paths a pixel"] = [replay_shot(replay, scene, paths, seed)]
    print(
        "| | image s | gradient s | both s | times ours | correlation |\n|---|---|---|---|---|---|"
    )
    best, base = by_amount(list(rows.values())[-1][0], scene.volume.density), 0.0
    for name, shots in rows.items():
        image, gradient = (
            median(part)
            for part in zip(*((s.image_seconds, s.gradient_seconds) for s in shots), strict=True)
        )
        base = base or image + gradient
        found = by_amount(shots[0], scene.volume.density)
        correlation = float(torch.corrcoef(torch.stack([found, best]))[0, 1])
        print(
            f"| {name} | {image:.2f} | {gradient:.2f} | {image + gradient:.2f} | "
            f"{(image + gradient) / base:.0f} | {correlation:.3f} |"
        )


if __name__ == "__main__":
    main()
