"""Experiments: known volumes, reconstructed as the run was, and how far off that is (E11.4).

What a run found is itself a volume whose pictures can be made. It is not quite like what is true: a
reconstruction of it lacks what this lacks of it. So the next experiment's volume gets that back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.lighting import solve_light
from ddrecon.picture import view_picture
from ddrecon.pictures.noise import LEAST
from ddrecon.reconstruct.gradients import share_pictures
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.objective import target_of
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.setup import given_noise
from ddrecon.scene import Scene
from ddrecon.variables.values import with_values

MORE_ROUNDS = 3
"""Transport rounds by which an experiment's pictures are closer to truth than the run's model."""
MOST_ROUNDS = 16


class Uncertainty:
    """Experiments, so many `wanted`, about what `run`, which is done, has found: a job.

    `values` are what was found, by name, and `errors` of each experiment so far how far it was from
    its own `truth`. `residuals` [3, h, w] are what is left of each training view's target, by name;
    `deviation` is that of all pixels.
    """

    def __init__(self, run: Reconstruction, seed: int, wanted: int = 2):
        self.run, self.parameters, self.seed = run, run.parameters, seed
        self.wanted, self.seconds = wanted, 0.0
        views, settings = run.level.train.views, run.problem.settings
        self.values = {p.name: p.value.detach() for p in run.parameters}
        images = photograph(run.level.train, self.values)
        self.residuals = {v.name: target_of(v) - images[v.name] for v in views}
        noises = {v.name: given_noise(v, settings) for v in views}
        self.is_noise_known = None not in noises.values()
        # Nothing is known better than a part of all pictures.
        powers = torch.stack([target_of(view).square().mean() for view in views])
        least = float(powers.mean()) * LEAST**2 + torch.finfo(torch.float32).tiny
        squares = list[Tensor]()
        for view in views:
            residual, view_noise = self.residuals[view.name], noises[view.name]
            left = residual if view.mask is None else residual * view.mask
            square = left.square().mean().clamp(min=least)
            if view_noise is not None:
                # Pictures err as they are known to; the fit has taken up some of their noise.
                known = view_noise.deviation(images[view.name]).square().mean()
                self.residuals[view.name] = residual * (known / square).sqrt().clamp(min=1)
                square = known.clamp(min=least)
            squares.append(square)
        self.deviation = float(torch.stack(squares).mean().sqrt())
        self.errors, self.truth = list[dict[str, Tensor]](), dict(self.values)
        self.trial: Reconstruction | None = None

    @property
    def count(self) -> int:
        """How many experiments are done."""
        return len(self.errors)

    @property
    def iteration(self) -> int:
        """How many iterations have been made, of all experiments."""
        return self.count * self.run.iteration + (self.trial.iteration if self.trial else 0)

    @property
    def total(self) -> int:
        """How many iterations there are at most."""
        return self.wanted * self.run.iteration

    @property
    def is_done(self) -> bool:
        """Whether all experiments are made."""
        return self.count >= self.wanted

    def step(self) -> str:
        """One more iteration; the last one of an experiment ends it."""
        start, text = perf_counter(), f"experiment {self.count + 1}"
        trial = self.trial = self.trial or self._begin()
        trial.step()
        if trial.is_done or trial.iteration >= self.run.iteration:
            self._end(trial)
        self.seconds += perf_counter() - start
        return text

    def _end(self, trial: Reconstruction) -> None:
        values = {p.name: p.value.detach() for p in trial.parameters}
        self.errors.append({name: values[name] - self.truth[name] for name in values})
        self.trial = None
        for p in self.parameters:
            if not is_tabled(p):
                # What the reconstruction lacks of its truth is what the run lacks of it, too.
                truth = self.truth[p.name] + self.values[p.name] - values[p.name]
                truth = truth.clamp(p.low, p.high)
                self.truth[p.name] = truth if p.support is None else truth * p.support

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        trial = None if self.trial is None else self.trial.state()
        names = "errors", "truth", "seconds"
        return {name: getattr(self, name) for name in names} | {"trial": trial}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Takes up where `state` was."""
        like = next(iter(self.values.values()))
        self.seconds = state["seconds"]
        self.errors = [{n: e.to(like) for n, e in entries.items()} for entries in state["errors"]]
        self.truth = {name: value.to(like) for name, value in state["truth"].items()}
        if state["trial"] is not None:
            self.trial = self._begin()
            self.trial.restore(state["trial"])

    def _begin(self) -> Reconstruction:
        """The next experiment: its pictures, and a run that is to find its `truth` from them.

        They err as those of the run do, the other way around; of later ones, either way by view.
        """
        problem = self.run.problem
        pictures = photograph(bring_closer(self.run.level.train), self.truth)
        generator = torch.Generator().manual_seed(self.seed % 2**31 + self.count)
        signs = torch.randint(0, 2, (len(pictures),), generator=generator) * 2 - 1
        views = list(problem.train.views)
        for at, view in enumerate(views):
            sign = int(signs[at]) if self.count else -1
            image = pictures[view.name] + sign * self.residuals[view.name]
            # Nothing is darker than what the pictures have.
            views[at] = replace(view, image=image.clamp(min=float(target_of(view).min())))
        return Reconstruction(replace(problem.scene, views=views, optimize=problem.settings))


def photograph(scene: Scene, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The pictures [3, h, w] of `scene` with `values`, by name."""
    with torch.no_grad():
        world = with_values(scene, values)
        light_field = solve_light(world, SolveMemory())
        return share_pictures(
            scene, lambda view: view_picture(light_field, world, world.view(view.name))
        )


def bring_closer(scene: Scene) -> Scene:
    """`scene` by more transport rounds, as far as its model has any."""
    diffusion = scene.diffusion
    if (diffusion.model, diffusion.scheme) != ("p1", "conservative"):
        return scene
    rounds = min(diffusion.rounds + MORE_ROUNDS, MOST_ROUNDS)
    return replace(scene, diffusion=replace(diffusion, transport_rounds=rounds))


def is_tabled(parameter: Parameter) -> bool:
    """Whether the entries of `parameter` are a table of numbers: it is no field and no map."""
    return not parameter.is_field and parameter.value.ndim < 3
