"""Path replay backpropagation in Mitsuba 3 (Vicini, Speierer and Jakob 2021), with room above the
densest cell; and the plume's image and gradient by every cell's density, by us and by it.

    DRJIT_LIBLLVM_PATH=... python benchmarks/path_replay.py [--pixels 512] [--paths 4 16]

Mitsuba's majorant is the greatest extinction in the grid. Where extinction reaches it there are no
null collisions, and those carry the derivative of transmittance: path replay does not see it there.
So cells are added around the grid, outside the box that holds the medium, one of them HEADROOM
times as dense as the densest within; images are the same.

Times are of this run only, on as many threads for both. Gradients are compared as sums of density
times gradient over blocks of 4^3 cells, each with that of the most paths. Needs the variant
`llvm_ad_rgb`.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool3d

from ddrecon.bench import Shot, shoot
from ddrecon.grid import Grid
from ddrecon.reference.mitsuba_scene import LONGEST, MEDIUM, mitsuba_scene, sensor_id
from ddrecon.reference.trace import load_mitsuba, make_mitsuba_objects
from ddrecon.scene import Scene
from ddrecon.validate.hard import plume_scene

RING = 2
REPEATS, BLOCK = 5, 4
HEADROOM = 2.0
DENSITY, ALBEDO = ".sigma_t.data", ".albedo.value.value"
"""How the names of density and of a constant albedo end among Mitsuba's parameters."""


@dataclass(frozen=True)
class Replay:
    """Mitsuba on views of a gray scene: `gradients` of a loss by what `parameters` are called
    `names`.
    """

    module: Any
    scene: Any
    parameters: Any
    integrator: Any
    headroom: float

    @staticmethod
    def of(scene: Scene, headroom: float = HEADROOM, views: int = 1) -> Replay:
        """That of the first `views` of `scene`, on as many threads as torch has; `headroom` 1: as
        Mitsuba comes.
        """
        module = load_mitsuba(torch.get_num_threads())
        described = mitsuba_scene(scene, scene.views[:views]) | {
            MEDIUM: mitsuba_scene(_pad_scene(scene, headroom), [])[MEDIUM]
        }
        loaded = module.load_dict(make_mitsuba_objects(module, described))
        integrator = module.load_dict(
            {"type": "prbvolpath", "max_depth": LONGEST, "rr_depth": 2 * LONGEST}
        )
        return Replay(module, loaded, module.traverse(loaded), integrator, headroom)

    def name(self, ending: str) -> str:
        """The parameter whose name ends so."""
        # Mitsuba's own mapping cannot be iterated over itself.
        (name,) = (key for key in self.parameters.keys() if key.endswith(ending))  # noqa: SIM118
        return str(name)

    def set_density(self, density: Tensor) -> None:
        """Puts `density` [z, y, x] into the scene."""
        self.parameters[self.name(DENSITY)] = self.module.TensorXf(
            pad_density(density, self.headroom).numpy()[..., None]
        )
        self.parameters.update()

    def image(self, seed: int, paths: int) -> np.ndarray:
        """The image [h, w, 3] by so many `paths` a pixel, float32."""
        return np.array(self.module.render(self.scene, sensor=0, seed=seed, spp=paths), np.float32)

    def gradients(
        self, loss_of: Callable[[Any], Any], names: list[str], seed: int, paths: int, view: int = 0
    ) -> tuple[float, list[np.ndarray]]:
        """`loss_of` the image of number `view` by so many `paths` a pixel, and its derivatives by
        the parameters called `names`.
        """
        import drjit

        (sensor,) = (s for s in self.scene.sensors() if s.id() == sensor_id(view))
        for name in names:
            drjit.enable_grad(self.parameters[name])
        self.parameters.update()
        image = self.module.render(
            self.scene,
            self.parameters,
            integrator=self.integrator,
            sensor=sensor,
            seed=seed,
            spp=paths,
        )
        loss = loss_of(image)
        drjit.backward(loss)
        found = [np.array(drjit.grad(self.parameters[name]), np.float32) for name in names]
        for name in names:
            drjit.disable_grad(self.parameters[name])
        return float(np.array(loss).item()), found

    def by_density(self, gradient: np.ndarray, density: Tensor) -> Tensor:
        """The derivative by the cells of `density` [z, y, x] from that by Mitsuba's grid."""
        leaf = density.detach().requires_grad_()
        padded = pad_density(leaf, self.headroom)
        (own,) = torch.autograd.grad(padded, leaf, torch.from_numpy(gradient).view_as(padded))
        return own


def pad_density(density: Tensor, headroom: float) -> Tensor:
    """`density` [z, y, x] with RING more cells on all sides, like their neighbors but for one in a
    corner, `headroom` times the densest.
    """
    padded = torch.nn.functional.pad(density[None, None], (RING,) * 6, mode="replicate")[0, 0]
    is_corner = torch.zeros_like(padded, dtype=torch.bool)
    is_corner[0, 0, 0] = True
    return torch.where(is_corner, headroom * density.detach().max(), padded)


def _pad_scene(scene: Scene, headroom: float) -> Scene:
    grid, volume = scene.volume.grid, scene.volume
    lower = tuple(low - RING * step for low, step in zip(grid.lower, grid.spacing, strict=True))
    upper = tuple(high + RING * step for high, step in zip(grid.upper, grid.spacing, strict=True))
    wide = Grid(tuple(count + 2 * RING for count in grid.shape), lower, upper)
    return replace(
        scene, volume=replace(volume, grid=wide, density=pad_density(volume.density, headroom))
    )


def why_not() -> str | None:
    """Why path replay cannot run here, or None."""
    try:
        import mitsuba  # noqa: F401
    except ImportError:
        return "needs Mitsuba 3: pip install ddrecon[reference]"
    return None if os.environ.get("DRJIT_LIBLLVM_PATH") else "needs an LLVM: set DRJIT_LIBLLVM_PATH"


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
    replay = Replay.of(scene, headroom=1.0)  # as Mitsuba comes, and fastest
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
