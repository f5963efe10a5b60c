"""The renderer as a layer in somebody's network."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.medium import Volume
from ddrecon.renderer import render
from ddrecon.world import Scene


class VolumeRenderer(torch.nn.Module):
    """Renders the views of `scene` with whatever fields its caller puts in place of the scene's own.

    Solutions are remembered from one call to the next as starting points, unless `scene.diffusion.warm_start` is off.
    """

    def __init__(self, scene: Scene):
        super().__init__()
        self.scene = scene
        self.memory = SolveMemory(scene.diffusion.warm_start)

    def forward(
        self,
        density: Tensor | None = None,
        sigma_a: Tensor | None = None,
        sigma_s: Tensor | None = None,
        g: Tensor | None = None,
        view: str | None = None,
    ) -> Tensor:
        """Images `[views, 3, h, w]` of all views, or of the one named `view`.

        `density`: [z, y, x] >= 0; `sigma_a`, `sigma_s` [1/u]: `[C]` or `[C, z, y, x]`; `g`: scalar in (-1, 1). What is None is the
        scene's. Raises ValueError for a density of another shape than the grid's.
        """
        own = self.scene.volume
        volume = Volume(
            own.grid,
            own.density if density is None else density,
            own.sigma_a if sigma_a is None else sigma_a,
            own.sigma_s if sigma_s is None else sigma_s,
            own.g if g is None else g,
        )
        self.memory.records.clear()
        return render(replace(self.scene, volume=volume), view, self.memory)
