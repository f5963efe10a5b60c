"""Experiments: known volumes, reconstructed as the run was, and how far off that is (E11.4).

What a run found is itself a volume whose pictures can be made. It is not quite like what is true: a
reconstruction of it lacks what this lacks of it. So the next experiment's volume gets that back.
A cell's deviation is the root mean square of the experiments' errors in the cells around it, times
`RATIO`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.io.files.atomic import write_json
from ddrecon.io.files.folders import UNCERTAINTY, Folder, kind_of_folder
from ddrecon.lighting import solve_light
from ddrecon.numerics.interpolation import mean_around
from ddrecon.picture import view_picture
from ddrecon.pictures import LEAST
from ddrecon.ranks import sum_over_ranks
from ddrecon.reconstruct.gradients import own_views
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.objective import target_of
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.setup import given_noise
from ddrecon.report.page import write_page
from ddrecon.report.volumes import Shown, describe_volume, describe_world
from ddrecon.run.job import Job, Outcome
from ddrecon.run.run_folder import write_values
from ddrecon.scene import Scene
from ddrecon.variables.kinds import kind_of, split_name
from ddrecon.variables.values import component_names, fields_of, with_values

MORE_ROUNDS, MOST_ROUNDS = 3, 16
"""Transport rounds by which an experiment's pictures are closer to truth than the run's model."""
RATIO = 1.55
"""The ratio of true to simulated errors, measured where the truth was known: volumes of experiments
lack what no reconstruction shows (docs/uncertainty.md)."""
EMPTY = 0.02
"""Cells of less than this part of the largest are empty, unless all are."""
WIDTH = 3
"""Cells a side over which errors are averaged."""
RECORD = "uncertainty.json"
ASSUMED = (
    "Deviations come from experiments: the reconstruction was photographed, with more transport"
    " rounds than the run had and the errors of its pictures, and reconstructed by the same"
    f" settings. They are scaled by {RATIO}, the ratio of true to simulated errors on four volumes"
    " of known truth. Cameras, lights and optics that were not optimized are taken for true, and of"
    " what no camera sees experiments say nothing."
)


class Uncertainty(Job):
    """Experiments, so many `wanted`, about what `run`, which is done, has found: a job.

    `values` are what was found, by name, and `errors` of each experiment so far how far it was from
    its own `truth`. `residuals` [3, h, w] are what is left of each training view's target, by name;
    `deviation` is that of all pixels.
    """

    def __init__(self, run: Reconstruction, seed: int, wanted: int = 2):
        self.parameters, self.seed = run.parameters, seed
        self.wanted, self.seconds, self.path = wanted, 0.0, Path()
        views, settings = run.level.train.views, run.problem.settings
        self.values = {p.name: p.value.detach() for p in run.parameters}
        sums = {name: float(value.double().abs().sum()) for name, value in self.values.items()}
        noise = None if settings.noise is None else vars(settings.noise)
        result_of = {"iteration": run.iteration, "values": sums, "seed": seed, "noise": noise}
        super().__init__(run, "uncertainty", result_of)
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
        return self.count * self.run.iteration + (self.trial.iteration if self.trial else 0)

    @property
    def total(self) -> int:
        return self.wanted * self.run.iteration

    @property
    def is_done(self) -> bool:
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
        trial = None if self.trial is None else self.trial.state()
        names = "errors", "truth", "seconds"
        return {name: getattr(self, name) for name in names} | {"trial": trial}

    def restore(self, state: Mapping[str, Any]) -> None:
        like = next(iter(self.values.values()))
        self.seconds = state["seconds"]
        self.errors = [{n: e.to(like) for n, e in entries.items()} for entries in state["errors"]]
        self.truth = {name: value.to(like) for name, value in state["truth"].items()}
        if state["trial"] is not None:
            self.trial = self._begin()
            self.trial.restore(state["trial"])

    def begin(self, folder: Folder, is_resumed: bool) -> None:
        self.path = folder.path
        super().begin(folder, is_resumed)

    def fields(self) -> dict[str, Field]:
        """The deviations of all fields and maps by the experiments so far, by name."""
        return {p.name: Field(self, p) for p in self.parameters if not is_tabled(p)}

    def numbers(self) -> dict[str, dict[str, float]]:
        """The value and the deviation of each number, and of the mass of each density, by name."""
        numbers, tabled = dict[str, dict[str, float]](), [*filter(is_tabled, self.parameters)]
        for p in self.parameters:
            if split_name(p.name)[1] == "density" and not is_tabled(p):
                cell = math.prod(p.grid.spacing)
                sums = torch.tensor([float(e[p.name].double().sum()) for e in self.errors])
                mass = cell * float(self.values[p.name].double().sum())
                numbers[f"mass of {p.name}"] = _with_deviation(mass, cell * sums)
        for p in tabled:
            # All views' numbers of one kind err alike, and so do all entries of other numbers.
            alike = [q for q in tabled if q.view is not None and q.key == p.key]
            names = [q.name for q in alike or [p]]
            stacked = [torch.stack([e[name].flatten() for name in names]) for e in self.errors]
            value = p.value.detach()
            entries = [p.name]
            if value.numel() > 1:
                components = component_names(p.name, value) or range(value.numel())
                entries = [f"{p.name}.{component}" for component in components]
            for at, name in enumerate(entries):
                errors = [e[:, at] if alike else e.square().mean(1).sqrt() for e in stacked]
                numbers[name] = _with_deviation(float(value.flatten()[at]), torch.cat(errors))
        return numbers

    def finish(self) -> Outcome:
        """Writes deviations, as volumes and as a page, and tells `uncertainty.json`."""
        fields, numbers, path = self.fields(), self.numbers(), self.path
        (path / "volumes").mkdir(exist_ok=True)
        for name, field in fields.items():
            for kind, values in {"std": field.deviation, "mean": field.value}.items():
                stem, is_map = path / "volumes" / f"{name}_{kind}", not kind_of(name).is_cellwise
                write_values(stem, stem.name, values, field.parameter.grid, is_map=is_map)
        source = "the scene" if self.is_noise_known else "residuals"
        record: dict[str, Any] = {
            "experiments": self.count,
            "seconds": self.seconds,
            "iterations": self.iteration,
            "noise": {"deviation": self.deviation, "from": source},
            "assumed": ASSUMED,
            "fields": {name: field.describe() for name, field in fields.items()},
            "numbers": numbers,
        }
        write_json(path / RECORD, record)
        lead = (
            f"Experiments: {self.count}, in {self.seconds:.1f} s; pictures err by"
            f" {self.deviation:.3g} of radiance (from {source})"
        )
        lines = [_field_text(name, field) for name, field in record["fields"].items()]
        rows = [(n, f"{x['value']:.5g} +- {x['deviation']:.2g}") for n, x in numbers.items()]
        scene = self.run.current_scene()
        volumes = {
            f"deviation of {n}": f.deviation for n, f in fields.items() if kind_of(n).is_cellwise
        }
        first = next(iter(volumes), "density")
        volumes = {name: value.cpu() for name, value in fields_of(scene).items()} | volumes
        cells = [Shown(name, "result", value) for name, value in volumes.items()]
        world = describe_world(scene.volume.grid, scene)
        write_page(
            path / "report.html",
            title=f"ddrecon: how sure a run is ({path.absolute().name})",
            lead=f"{lead}.",
            volume=describe_volume(cells, world, lines, first),
            numbers={"heading": "Numbers", "head": ("", ""), "rows": rows, "text": ASSUMED},
        )
        return record, [lead, *lines, *(f"{name}: {text}" for name, text in rows), ASSUMED]

    def _begin(self) -> Reconstruction:
        """The next experiment: its pictures, and a run that is to find its `truth` from them.

        They err as those of the run do, the other way around; of later ones, either way by view.
        """
        problem, train = self.run.problem, self.run.level.train
        diffusion = train.diffusion
        if (diffusion.model, diffusion.scheme) == ("p1", "conservative"):
            rounds = min(diffusion.rounds + MORE_ROUNDS, MOST_ROUNDS)
            train = replace(train, diffusion=replace(diffusion, transport_rounds=rounds))
        pictures = photograph(train, self.truth)
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
    names = [view.name for view in scene.views]
    rendered = own_views(scene, names)
    with torch.no_grad():
        world = with_values(scene, values)
        light_field = solve_light(world, SolveMemory())
        pictures = [
            view_picture(light_field, world, world.view(view.name))
            if view.name in rendered
            else scene.volume.density.new_zeros(3, *view.camera.size)
            for view in scene.views
        ]
    return dict(zip(names, sum_over_ranks(pictures), strict=True))


def is_tabled(parameter: Parameter) -> bool:
    """Whether the entries of `parameter` are a table of numbers: it is no field and no map."""
    return not parameter.is_field and parameter.value.ndim < 3


class Field:
    """The deviations [..., z, y, x] of the field, or map, of `parameter`, by `experiments`."""

    def __init__(self, experiments: Uncertainty, parameter: Parameter):
        self.parameter, name = parameter, parameter.name
        self.value = experiments.values[name].cpu().double()
        self.errors = [errors[name].cpu().double() for errors in experiments.errors]
        self.squares = [mean_around(error.square(), WIDTH) for error in self.errors]
        self.is_smoke = self.value.abs() >= EMPTY * self.value.abs().max()
        self.deviation = self.deviation_by(self.squares)

    def deviation_by(self, squares: Sequence[Tensor]) -> Tensor:
        """The deviation of each cell by some experiments' mean `squares` of errors around it."""
        tiny = torch.finfo(torch.float32).tiny
        return RATIO * torch.stack([*squares]).mean(0).sqrt().clamp(min=tiny)

    def describe(self) -> dict[str, float | None]:
        """Root mean squares over the smoke, and the shares of errors within 1 and 2 deviations.

        Deviations there are by the other experiments; of a single one nothing is known.
        """
        ratios = [
            (error.abs() / self.deviation_by(others))[self.is_smoke]
            for at, error in enumerate(self.errors)
            if (others := self.squares[:at] + self.squares[at + 1 :])
        ]
        return {
            "root_mean_square": float(self.value[self.is_smoke].square().mean()) ** 0.5,
            "deviation": float(self.deviation[self.is_smoke].square().mean()) ** 0.5,
            **{
                f"within_{k}": float((torch.cat(ratios) < k).double().mean()) if ratios else None
                for k in (1, 2)
            },
        }


def volumes_in(folder: Path) -> list[Path]:
    """The volumes of the `folder` of experiments, in order; else none."""
    is_sure = kind_of_folder(folder) == UNCERTAINTY
    return sorted((folder / "volumes").glob("*.npz")) if is_sure else []


def _field_text(name: str, field: Mapping[str, Any]) -> str:
    """How far off a field is, and how often that held in experiments."""
    size, of = field["deviation"], field["root_mean_square"]
    text = f"{name}: deviation {size:.3g} of {of:.3g} (root mean squares over the smoke)"
    if field["within_1"] is None:
        return text
    shares = " and ".join(f"{100 * field[f'within_{k}']:.0f} %" for k in (1, 2))
    return f"{text}; of errors in experiments {shares} lay within one and two deviations"


def _with_deviation(value: float, errors: Tensor) -> dict[str, Any]:
    """A number with its deviation, by the `errors` of experiments: wider where there are few."""
    size = float(errors.double().square().mean().sqrt())
    return {"value": value, "deviation": RATIO * (1 + 2 / len(errors)) * size}
