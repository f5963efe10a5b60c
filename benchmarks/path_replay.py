"""Path replay backpropagation in Mitsuba 3 (Vicini, Speierer and Jakob 2021): the plume's image and
its gradient by every cell's density, by us and by it.

    DRJIT_LIBLLVM_PATH=... python benchmarks/path_replay.py [--paths 4 16]

Times are of this run only, on as many threads for both. Gradients are compared as sums of density
times gradient over blocks of 4^3 cells, each with that of the most paths. Needs the variant
`llvm_ad_rgb`.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
import torch
from figures import print_header, print_row
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool3d

from ddrecon.bench import Shot, plume_scene, shoot
from ddrecon.reference.mitsuba_scene import LONGEST, mitsuba_scene, sensor_id
from ddrecon.reference.trace import load_mitsuba, make_mitsuba_objects
from ddrecon.scene import Scene

REPEATS, BLOCK = 5, 4
DENSITY = ".sigma_t.data"
"""How the name of density ends among Mitsuba's parameters."""


@dataclass(frozen=True)
class Replay:
    """Mitsuba on views of a gray `scene`, whose density is called `name` among its `parameters`."""

    module: Any
    scene: Any
    parameters: Any
    integrator: Any
    name: str

    @staticmethod
    def of(scene: Scene, views: int = 1) -> Replay:
        """That of the first `views` of `scene`, on as many threads as torch has."""
        if not os.environ.get("DRJIT_LIBLLVM_PATH"):
            raise SystemExit("path replay needs an LLVM: set DRJIT_LIBLLVM_PATH")
        module = load_mitsuba(torch.get_num_threads())
        described = mitsuba_scene(scene, scene.views[:views])
        loaded = module.load_dict(make_mitsuba_objects(module, described))
        kind = {"type": "prbvolpath", "max_depth": LONGEST, "rr_depth": 2 * LONGEST}
        parameters = module.traverse(loaded)
        # Mitsuba's own mapping cannot be iterated over itself.
        (name,) = (key for key in parameters.keys() if key.endswith(DENSITY))  # noqa: SIM118
        return Replay(module, loaded, parameters, module.load_dict(kind), name)

    def set_density(self, density: Tensor) -> None:
        """Puts `density` [z, y, x] into the scene."""
        self.parameters[self.name] = self.module.TensorXf(density.numpy()[..., None])
        self.parameters.update()

    def gradient(
        self, loss_of: Callable[[Any], Any], seed: int, paths: int, view: int = 0
    ) -> Tensor:
        """The derivative [z, y, x] of `loss_of` the image of number `view` by density."""
        import drjit

        (sensor,) = (s for s in self.scene.sensors() if s.id() == sensor_id(view))
        density = self.parameters[self.name]
        drjit.enable_grad(density)
        self.parameters.update()
        options = {"integrator": self.integrator, "sensor": sensor, "seed": seed, "spp": paths}
        drjit.backward(loss_of(self.module.render(self.scene, self.parameters, **options)))
        gradient = np.array(drjit.grad(density), np.float32)
        drjit.disable_grad(density)
        return torch.from_numpy(gradient[..., 0])


def replay_shot(replay: Replay, paths: int, seed: int) -> Shot:
    """The image and the gradient of its mean, by so many `paths` a pixel."""
    import drjit

    start = perf_counter()
    rendered = replay.module.render(replay.scene, sensor=0, seed=seed, spp=paths)
    image = torch.from_numpy(np.array(rendered, np.float32))
    middle = perf_counter()
    gradient = replay.gradient(lambda image: drjit.mean(image, axis=None), seed, paths)
    return Shot(image, gradient, middle - start, perf_counter() - middle, paths)


def by_amount(shot: Shot, density: Tensor) -> Tensor:
    """What changes as all density of a block grows by a factor; empty cells have no part in it."""
    blocks = [max(1, size // BLOCK) for size in density.shape]
    return adaptive_avg_pool3d((shot.gradient * density)[None], blocks).flatten().double()


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--paths", type=int, nargs="+", default=[4, 16])
    given = parser.parse_args()
    scene = plume_scene(64, 512, torch.float32, torch.device("cpu"))
    replay = Replay.of(scene)
    rows = {"ours": [shoot(scene) for _ in range(REPEATS + 1)][1:]}
    replay_shot(replay, 1, len(given.paths))  # compiles
    for seed, paths in enumerate(given.paths):
        rows[f"Mitsuba, {paths} paths a pixel"] = [replay_shot(replay, paths, seed)]
    print_header("", "image s", "gradient s", "both s", "times ours", "correlation")
    best, base = by_amount(list(rows.values())[-1][0], scene.volume.density), 0.0
    for name, shots in rows.items():
        image = median(shot.image_seconds for shot in shots)
        gradient = median(shot.gradient_seconds for shot in shots)
        base = base or image + gradient
        found = by_amount(shots[0], scene.volume.density)
        correlation = float(torch.corrcoef(torch.stack([found, best]))[0, 1])
        seconds = (f"{part:.2f}" for part in (image, gradient, image + gradient))
        print_row(name, *seconds, f"{(image + gradient) / base:.0f}", correlation)


if __name__ == "__main__":
    main()
