"""Experiments: known volumes, reconstructed as the run was, and how far off that is (E11.4).

What a run found is itself a volume whose pictures can be made. It is not quite like what is true: a
reconstruction of it lacks what this lacks of it. So the next experiment's volume gets that back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.lighting import solve_light
from ddrecon.picture import view_picture
from ddrecon.pictures.noise import LEAST, Noise
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.objective import target_of
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.setup import given_noise
from ddrecon.reconstruct.shares import share_pictures
from ddrecon.scene import Scene
from ddrecon.uncertainty.curvature import Curvature
from ddrecon.variables.values import with_values

MORE_ROUNDS = 3
"""Transport rounds by which an experiment's pictures are closer to truth than the run's model."""
MOST_ROUNDS = 16
PROBES = 3
"""Random pictures by which it is found what pictures tell of each cell."""
STATE = ("count", "errors", "truth", "information")
"""The state that a checkpoint keeps besides the current experiment."""


class Uncertainty:
    """Experiments about what `run`, which is done, has found; `step` makes one iteration of them.

    `values` are what was found, by name, and `errors` of each experiment so far how far it was from
    its own `truth`. `residuals` [3, h, w] are what is left of each training view's target, by name,
    and `noise`, of all pictures, replaces what the scene says. `information` is the diagonal of
    J^T W J, W being 1 over the variance of pixels: from random pictures, drawn by `seed`.
    """

    def __init__(self, run: Reconstruction, seed: int, noise: Noise | None = None):
        self.run, self.parameters, self.seed = run, run.parameters, seed
        level, settings = run.level, run.problem.settings
        self.curvature = Curvature(level.train, run.parameters, level.targets, run.memory.last)
        self.values = self.curvature.values
        images = self.curvature.images
        self.residuals = {v.name: target_of(v) - images[v.name] for v in level.train.views}
        noises = {v.name: noise or given_noise(v, settings) for v in level.train.views}
        self.is_noise_known = None not in noises.values()
        # Nothing is known better than a part of all pictures.
        powers = [target_of(view).square().mean() for view in level.train.views]
        least = float(torch.stack(powers).mean()) * LEAST**2 + torch.finfo(torch.float32).tiny
        squares = dict[str, Tensor]()
        for view in level.train.views:
            name, view_noise = view.name, noises[view.name]
            seen = torch.ones(view.camera.size) if view.mask is None else view.mask
            residual = (self.residuals[name] * seen.to(images[name])).square().mean()
            square = residual
            if view_noise is not None:
                # Pictures err as they are known to; the fit has taken up some of their noise.
                square = view_noise.deviation(images[name]).square().mean()
                self.residuals[name] *= (square / residual.clamp(min=least)).sqrt().clamp(min=1)
            squares[name] = square.clamp(min=least)
            weight = seen.to(images[name]) / squares[name]
            self.curvature.weights[name] = weight.expand_as(images[name])
        self.deviation = float(torch.stack(list(squares.values())).mean().sqrt())
        self.information = self._find_information(torch.Generator().manual_seed(seed % 2**31))
        self.count, self.errors = 0, list[dict[str, Tensor]]()
        self.truth = dict(self.values)
        self.trial: Reconstruction | None = None

    @property
    def iteration(self) -> int:
        """How many iterations have been made, of all experiments."""
        return self.count * self.run.iteration + (self.trial.iteration if self.trial else 0)

    def step(self) -> None:
        """One more iteration; the last one of an experiment ends it."""
        trial = self.trial = self.trial or self._begin()
        trial.step()
        if not trial.is_done and trial.iteration < self.run.iteration:
            return
        values = {p.name: p.value.detach() for p in trial.parameters}
        self.errors.append({name: values[name] - self.truth[name] for name in values})
        self.count, self.trial = self.count + 1, None
        for p in self.parameters:
            if not is_tabled(p):
                # What the reconstruction lacks of its truth is what the run lacks of it, too.
                truth = self.truth[p.name] + self.values[p.name] - values[p.name]
                truth = truth.clamp(p.low, p.high)
                self.truth[p.name] = truth if p.support is None else truth * p.support

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        trial = None if self.trial is None else self.trial.state()
        return {name: getattr(self, name) for name in STATE} | {"trial": trial}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Takes up where `state` was."""
        like = next(iter(self.values.values()))
        self.count = state["count"]
        self.errors = [{n: e.to(like) for n, e in entries.items()} for entries in state["errors"]]
        for name in ("truth", "information"):
            setattr(self, name, {n: value.to(like) for n, value in state[name].items()})
        if state["trial"] is not None:
            self.trial = self._begin()
            self.trial.restore(state["trial"])

    def _begin(self) -> Reconstruction:
        """The next experiment: its pictures, and a run that is to find its `truth` from them.

        They err as those of the run do, the other way around; of later ones, either way by view.
        """
        problem, level = self.run.problem, self.run.level
        pictures = self._photograph(level.train)
        generator = torch.Generator().manual_seed(self.seed % 2**31 + self.count)
        signs = torch.randint(0, 2, (len(pictures),), generator=generator) * 2 - 1
        views = list(problem.train.views)
        for at, view in enumerate(views):
            sign = int(signs[at]) if self.count else -1
            image = pictures[view.name] + sign * self.residuals[view.name]
            # Nothing is darker than what the pictures have.
            views[at] = replace(view, image=image.clamp(min=float(target_of(view).min())))
        return Reconstruction(replace(problem.scene, views=views, optimize=problem.settings))

    def _photograph(self, scene: Scene) -> dict[str, Tensor]:
        """The pictures [3, h, w] of the `truth`, by more transport rounds than those of `scene`."""
        diffusion = scene.diffusion
        if (diffusion.model, diffusion.scheme) == ("p1", "conservative"):
            rounds = min(diffusion.rounds + MORE_ROUNDS, MOST_ROUNDS)
            scene = replace(scene, diffusion=replace(diffusion, transport_rounds=rounds))
        with torch.no_grad():
            world = with_values(scene, self.truth)
            light_field = solve_light(world, SolveMemory())
            return share_pictures(
                scene, lambda view: view_picture(light_field, world, world.view(view.name))
            )

    def _find_information(self, generator: torch.Generator) -> dict[str, Tensor]:
        """The mean square of J^T W^(1/2) times random pictures, by name."""
        total, curvature = torch.zeros(self.curvature.size), self.curvature
        for _ in range(PROBES):
            random = {
                name: weight.sqrt().cpu() * torch.randn(weight.shape, generator=generator)
                for name, weight in curvature.weights.items()
            }
            random = {name: noise.to(curvature.images[name]) for name, noise in random.items()}
            probe = curvature.adjoint(random)
            total = total.to(probe) + probe.square() / PROBES
        return curvature.split(total)


def is_tabled(parameter: Parameter) -> bool:
    """Whether the entries of `parameter` are a table of numbers: it is no field and no map."""
    return not parameter.is_field and parameter.value.ndim < 3
