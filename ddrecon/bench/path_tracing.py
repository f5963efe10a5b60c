"""The same scene by Mitsuba 3: the truth, and a contestant at several sample counts.

Gradients are those of path replay backpropagation (Vicini, Speierer and Jakob 2021,
doi:10.1145/3450626.3459804), which needs the variant `llvm_ad_rgb`, and a medium of constant and
gray cross sections.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np
import torch
from torch import Tensor

from ddrecon.bench.measure import Shot, block_sums, blocks_of
from ddrecon.reference.mitsuba_scene import LONGEST
from ddrecon.reference.trace import Traced, Tracer, open_tracer
from ddrecon.scene import Scene

DENSITY = ".sigma_t.data"
"""How the name of the density ends among Mitsuba's parameters."""
TRUTH_SEED = 1000
"""Seeds of the truth's passes begin here: no contestant's path is among them."""


@dataclass(frozen=True)
class Truth:
    """Path tracing: `image` [3, h, w], and `by_amount` [z, y, x] where there is path replay."""

    image: Traced
    by_amount: Traced | None = None


class PathTracer:
    """Mitsuba on the first view of `scene`, with gradients where wanted and possible.

    Raises MissingExtraError without Mitsuba, SceneError for what it cannot show.
    """

    def __init__(self, scene: Scene, has_gradient: bool):
        self.scene, self.blocks = scene, blocks_of(scene)
        self.tracer = open_tracer(scene, scene.views[:1], threads=torch.get_num_threads())
        self.replay = (
            _replay(self.tracer, scene)
            if has_gradient and _has_replay(self.tracer, scene)
            else None
        )

    def shoot(self, samples: int, seed: int = 0) -> Shot:
        """An image by so many paths a pixel, and its gradient.

        Without path replay that is zeros that took no time.
        """
        start = perf_counter()
        image = torch.from_numpy(self.tracer.trace(0, seed, samples)).movedim(-1, 0)
        middle = perf_counter()
        gradient = (
            torch.zeros(self.scene.volume.grid.shape)
            if self.replay is None
            else self.replay(samples, seed)
        )
        end = perf_counter()
        sums = (
            block_sums(gradient, self.blocks),
            block_sums(gradient * self.scene.volume.density.detach().cpu(), self.blocks),
        )
        return Shot(image, *sums, middle - start, end - middle, samples)

    def truth(self, samples: int, passes: int) -> Truth:
        """The mean of several passes."""
        shots = [self.shoot(samples, TRUTH_SEED + index) for index in range(passes)]
        image = Traced.of([shot.image.numpy() for shot in shots])
        if self.replay is None:
            return Truth(image)
        return Truth(image, Traced.of([shot.by_amount.double().numpy() for shot in shots]))


def _has_replay(tracer: Tracer, scene: Scene) -> bool:
    is_plain = scene.volume.sigma_a.numel() == scene.volume.sigma_s.numel() == 1
    return is_plain and tracer.module.variant() == "llvm_ad_rgb"


def _replay(tracer: Tracer, scene: Scene) -> Callable[[int, int], Tensor]:
    """A function that gives the gradient [z, y, x] by path replay, from paths a pixel and seed.

    It is that of the image's mean by density.
    """
    import drjit

    (loaded,) = tracer.scenes
    integrator = tracer.module.load_dict(
        {"type": "prbvolpath", "max_depth": LONGEST, "rr_depth": 2 * LONGEST}
    )
    parameters = tracer.module.traverse(loaded)
    keys = parameters.keys()  # of Mitsuba's own mapping
    (name,) = (key for key in keys if key.endswith(DENSITY))

    def gradient(samples: int, seed: int) -> Tensor:
        drjit.enable_grad(parameters[name])
        parameters.update()
        image = tracer.module.render(
            loaded, parameters, integrator=integrator, sensor=0, seed=seed, spp=samples
        )
        drjit.backward(drjit.mean(image, axis=None))
        found = np.array(drjit.grad(parameters[name]), np.float32).reshape(scene.volume.grid.shape)
        drjit.disable_grad(parameters[name])
        parameters.update()
        return torch.from_numpy(found)

    return gradient
