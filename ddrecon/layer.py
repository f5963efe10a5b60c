"""The renderer as a layer in somebody's network."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.renderer import render
from ddrecon.scene import Scene
from ddrecon.variables.values import with_values


class VolumeRenderer(torch.nn.Module):
    """Renders the views of `scene`, with fields of its caller in place of the scene's own.

    Solutions are remembered from one call to the next as starting points, unless
    `scene.diffusion.warm_start` is off.
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
        values: Mapping[str, Tensor] | None = None,
    ) -> Tensor:
        """Images `[views, 3, h, w]` of all views, or of the one named `view`.

        `density`: [z, y, x] >= 0; `sigma_a`, `sigma_s` [1/u]: `[C]` or `[C, z, y, x]`; `g`: scalar
        in (-1, 1); `values`: anything else by name, such as `lights.0.irradiance`
        (`ddrecon.variables`). What is not given is the scene's. Raises KeyError for a name the
        scene does not have, ValueError for a density of another shape than the grid's.
        """
        fields = {"density": density, "sigma_a": sigma_a, "sigma_s": sigma_s, "g": g}
        given = {name: value for name, value in fields.items() if value is not None}
        self.memory.records.clear()
        return render(with_values(self.scene, {**given, **(values or {})}), view, self.memory)
