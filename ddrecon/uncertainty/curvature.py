"""A run's second derivative by Gauss and Newton, J^T W J: what its factors are (E11.1).

J is the derivative of all training pictures by all parameters, W how strongly each pixel counts.
Nobody has the matrix: a product with J^T is one adjoint, view by view, in one light field, shared
out over ranks. Its memory grows with the views by their pictures alone.
Parameters stand in one vector, entry by entry, in their own units and in their order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.lighting import solve_light
from ddrecon.losses import Target
from ddrecon.picture import view_picture
from ddrecon.reconstruct.gradients import differentiate
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.shares import share_pictures
from ddrecon.scene import Scene, View
from ddrecon.variables.values import with_values


class Curvature:
    """J^T W J at the values of `parameters`, which stand in `scene` with its training views.

    `targets` are the views' by name. `images` [3, h, w] are the views' as rendered, `weights`
    [3, h, w] is W: that of the objective, unless it is replaced.
    """

    def __init__(
        self,
        scene: Scene,
        parameters: Sequence[Parameter],
        targets: Mapping[str, Target],
        solutions: Mapping[tuple[str, int], Tensor] | None = None,
    ):
        self.scene, self.parameters = scene, list(parameters)
        self.values = {p.name: p.value.detach() for p in parameters}
        self.solutions = dict(solutions or {})
        memory = self.new_memory()
        with torch.no_grad():
            world = with_values(scene, self.values)
            light_field = solve_light(world, memory)
            self.images = share_pictures(
                scene, lambda view: view_picture(light_field, world, world.view(view.name))
            )
        # Later solves of the same light begin where this one ended.
        self.solutions = {key: u for key, u in memory.last.items() if key[0] == "forward"}
        total = sum(view.weight for view in scene.views)
        self.weights = {
            view.name: view.weight / total * targets[view.name].weights_at(self.images[view.name])
            for view in scene.views
        }

    @property
    def size(self) -> int:
        """How many entries a vector has."""
        return sum(value.numel() for value in self.values.values())

    def join(self, tensors: Mapping[str, Tensor]) -> Tensor:
        """`tensors` by name as one vector; what is missing is 0."""
        like = self.values.items()
        joined = [tensors.get(name, torch.zeros_like(value)).reshape(-1) for name, value in like]
        return torch.cat(joined)

    def split(self, vector: Tensor) -> dict[str, Tensor]:
        """The parts of `vector` by name, each in the shape of its parameter."""
        chunks = vector.split([value.numel() for value in self.values.values()])
        named = zip(self.values.items(), chunks, strict=True)
        return {name: chunk.view(value.shape) for (name, value), chunk in named}

    def adjoint(self, pictures: Mapping[str, Tensor]) -> Tensor:
        """J^T times `pictures` [3, h, w] of all views by name."""

        def along(view: View, image: Tensor) -> Tensor:
            return (image * pictures[view.name]).sum()

        leaves = {name: value.clone().requires_grad_() for name, value in self.values.items()}
        names = [view.name for view in self.scene.views]
        return self.join(
            differentiate(self.scene, names, leaves, along, self.new_memory()).gradients
        )

    def new_memory(self) -> SolveMemory:
        """What solves begin from: the same each time, so that a product depends on nothing else."""
        return SolveMemory(last=dict(self.solutions))
