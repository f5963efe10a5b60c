"""Fig. 7 of docs/experiments.md: density from one picture, by us and by path replay backpropagation
in Mitsuba 3, 64 paths a pixel.

    DRJIT_LIBLLVM_PATH=... python benchmarks/paper_path_replay.py [-o FOLDER] [--iterations 40]
                                                                  [--keep]

All look at the picture of configs/paper/fig07.yaml, in pixels two or three times as large, start
from the same density, and step by Adam at the same rates against the same loss and the same total
variation. Seconds are those of the processor, on one thread. What each found is judged by path
tracing: the mean of products of two errors, each of a trace and of a target of its own, is the
squared error without their noise. `--keep` takes finished runs as they are.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib
import numpy as np
import torch
from figures import keep
from paper_figures import CONFIGS, PICTURES, ROOT, SHAPES, Array, project, save, show
from path_replay import DENSITY, HEADROOM, Replay, why_not

from ddrecon.io.volumes.table import read_field
from ddrecon.reconstruct.frame import Frame
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reference.trace import open_tracer
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene

matplotlib.use("Agg")
import matplotlib.pyplot as plt

CONFIG, TARGET = CONFIGS / "fig07.yaml", ROOT / "data" / "paper" / "fig07"
PATHS, RATE, RAYS = 64, 0.1, 4
"""Paths and rays a pixel of theirs and of ours; learning rate at first."""
FINAL_RATE = 0.2
"""The part to which it falls."""
ENLARGED = 256
"""Pixels a side of the picture that is only timed: the smallest of the paper's."""
JUDGED_AT = (5, 15, 40)
JUDGING, CONVERGED = 64, 512
"""Paths a pixel of each trace that judges, and of each target."""
TOP = (
    "| pixels | total variation | | seconds an iteration | times ours | error, shown view | "
    "novel view | L1 error of density | along z |\n"
    "|---|---|---|---|---|---|---|---|---|\n"
)


@dataclass(frozen=True)
class Found:
    """Seconds and loss of each iteration, and the density [z, y, x] after some."""

    seconds: list[float]
    losses: list[float]
    densities: dict[int, Array]


Contender = Callable[[Scene, int], Found]


class Steps:
    """Steps of a `parameter` by Adam, at rates that fall over so many `iterations`.

    Pictures by paths are too noisy for a search that compares losses.
    """

    def __init__(self, parameter: Parameter, iterations: int):
        self.parameter = parameter
        self.adam = torch.optim.Adam([parameter.value], RATE)
        fall = FINAL_RATE ** (1 / iterations)
        self.rates = torch.optim.lr_scheduler.ExponentialLR(self.adam, fall)

    def step(self, gradient: torch.Tensor) -> None:
        """Moves the parameter against `gradient`, within its bounds."""
        value = self.parameter.value
        value.grad = gradient
        self.adam.step()
        self.rates.step()
        with torch.no_grad():
            value.copy_(self.parameter.project(value))


def by_us(scene: Scene, iterations: int) -> Found:
    """Our derivatives."""
    frame, found = Frame(scene, iterations), Found([], [], {})
    frame.enter(len(frame.problem.factors) - 1)
    (parameter,) = frame.parameters
    steps = Steps(parameter, iterations)
    for _ in range(iterations):
        start = time.process_time()
        objective = frame.evaluate().objective
        steps.step(objective.slopes(1.0)["density"])
        seconds = time.process_time() - start
        _note(found, seconds, objective.total(1.0), parameter.value.detach())
    return found


def by_path_replay(scene: Scene, iterations: int, headroom: float = 1.0) -> Found:
    """The same by path replay, with Mitsuba's majorant raised to `headroom` times the densest; its
    losses are those of noisy pictures.
    """
    import drjit

    settings = scene.optimize.parameters["density"]
    parameter = Parameter("density", settings, scene.starts["density"], scene.volume.grid)
    steps = Steps(parameter, iterations)
    target = scene.views[0].image.movedim(0, -1)
    replay, found, power = (
        Replay.of(scene, headroom),
        Found([], [], {}),
        float(target.square().mean()),
    )
    wanted = replay.module.TensorXf(target.numpy())
    for iteration in range(iterations):
        start, density = time.process_time(), parameter.value.detach()
        replay.set_density(density)
        loss, (gradient,) = replay.gradients(
            lambda image: drjit.mean(drjit.square(image - wanted), axis=None),
            [replay.name(DENSITY)],
            iteration,
            PATHS,
        )
        penalty, smooth = parameter.penalty() or (0.0, 0.0)
        steps.step(replay.by_density(gradient, density) / power + smooth)
        total = loss / power + float(penalty)
        _note(found, time.process_time() - start, total, parameter.value.detach())
    return found


def _note(found: Found, seconds: float, loss: float, density: torch.Tensor) -> None:
    found.seconds.append(seconds)
    found.losses.append(loss)
    if len(found.losses) in JUDGED_AT:
        found.densities[len(found.losses)] = density.numpy().copy()
    if len(found.losses) % 10 == 0:
        print(f"  {len(found.losses)}: {sum(found.seconds):.1f} s, loss {loss:.3g}", flush=True)


CONTENDERS: dict[str, tuple[Contender, tuple[str, ...]]] = {
    "ours": (by_us, ()),
    "ours, one round": (by_us, ("diffusion.transport_rounds=1",)),
    "path replay": (by_path_replay, ()),
    "path replay, higher majorant": (
        lambda scene, iterations: by_path_replay(scene, iterations, HEADROOM),
        (),
    ),
}
CASES = (
    (3, 0.0, ("ours", "path replay", "path replay, higher majorant")),
    (2, None, ("ours", "ours, one round", "path replay")),
)
"""How much larger pixels are, the weight of the total variation (None: its default), and who
competes.
"""


def enlarge(picture: Array, times: int) -> Array:
    """`picture` [h, w, 3] in pixels `times` times as large."""
    height, width = (size // times for size in picture.shape[:2])
    mean: Array = (
        picture[: height * times, : width * times]
        .reshape(height, times, width, times, 3)
        .mean((1, 3))
    )
    return mean


def scene_of(picture: Array, folder: Path, overrides: tuple[str, ...], tv: float | None) -> Scene:
    """The scene to reconstruct from `picture` [h, w, 3] alone."""
    path = folder / f"front_{len(picture)}.npy"
    np.save(path, picture)
    settings = {
        "render.samples_per_pixel": RAYS,
        "views.0.image": path.resolve(),
    }
    weights = {} if tv is None else {"optimize.parameters.density.tv": tv}
    scene = load_scene(
        CONFIG,
        overrides=[*(f"{key}={value}" for key, value in (settings | weights).items()), *overrides],
    )
    return replace(scene, views=scene.views[:1])


@dataclass(frozen=True)
class Judge:
    """Path tracing: two `targets` [h, w, 3] of each view of `scene`, each with noise of its own."""

    scene: Scene
    targets: list[list[Array]]

    @staticmethod
    def of(folder: Path) -> Judge:
        """That of the true volume, traced unless `folder` has it."""
        scene = load_scene(CONFIG, overrides=[f"volume.density={{file: {SHAPES / 'cloud.npz'}}}"])
        path = folder / "targets.npy"
        if not path.exists():
            np.save(
                path,
                _trace(scene, scene.volume.density.numpy(), CONVERGED, 1000, len(scene.views)),
            )
        return Judge(scene, np.load(path))

    def errors(self, density: Array, times: int, views: int) -> list[float]:
        """The mean squared error of each of the first `views`, in pixels `times` times as large,
        without noise.
        """
        pictures = _trace(self.scene, density, JUDGING, 0, views)
        pairs = [
            [enlarge(a - b, times) for a, b in zip(*both, strict=True)]
            for both in zip(pictures, self.targets, strict=False)
        ]
        return [float((first * second).mean()) for first, second in pairs]


def _trace(scene: Scene, density: Array, paths: int, seed: int, views: int) -> list[list[Array]]:
    """Two pictures of each of the first `views`, each `seed` and those after it with paths of its
    own.
    """
    scene = replace(scene, volume=replace(scene.volume, density=torch.from_numpy(density)))
    tracer = open_tracer(scene, scene.views, threads=torch.get_num_threads())
    return [
        [tracer.trace(view, seed + 2 * view + turn, paths) for turn in range(2)]
        for view in range(views)
    ]


@dataclass(frozen=True)
class Entry:
    """One run: the case it is of, what it found, and its squared errors where judged, in the end of
    the novel view too.
    """

    case: tuple[int, float | None]
    name: str
    found: Found
    errors: dict[int, list[float]]


def run(
    case: tuple[int, float | None],
    name: str,
    folder: Path,
    iterations: int,
    judge: Judge,
    is_kept: bool,
) -> Entry:
    """Runs a contender, or reads what it did."""
    times, tv = case
    words = (times, "default" if tv is None else tv, *name.replace(",", "").split())
    path = folder / f"{'_'.join(map(str, words))}.npz"
    if not (is_kept and path.exists()):
        contender, overrides = CONTENDERS[name]
        picture = enlarge(np.load(TARGET / "front.npy").astype(np.float32), times)
        print(f"{len(picture)} pixels, total variation {tv}, {name}", flush=True)
        found = contender(scene_of(picture, folder, overrides, tv), iterations)
        errors = {
            i: judge.errors(density, times, 2 if i == iterations else 1)
            for i, density in found.densities.items()
        }
        densities = {
            f"density_{iteration}": density for iteration, density in found.densities.items()
        }
        judged = {f"errors_{iteration}": values for iteration, values in errors.items()}
        np.savez_compressed(path, seconds=found.seconds, losses=found.losses, **densities, **judged)
    kept = np.load(path)
    at = [int(key.removeprefix("density_")) for key in kept if key.startswith("density_")]
    found = Found(
        list(kept["seconds"]),
        list(kept["losses"]),
        {iteration: kept[f"density_{iteration}"] for iteration in at},
    )
    return Entry(
        case, name, found, {iteration: list(kept[f"errors_{iteration}"]) for iteration in at}
    )


def paces(folder: Path, is_kept: bool) -> dict[str, float]:
    """Seconds of an iteration at `ENLARGED` pixels a side, the picture being enlarged and good for
    nothing else.
    """
    path = folder / "paces.json"
    if is_kept and path.exists():
        return dict(json.loads(path.read_text()))
    picture = torch.from_numpy(np.load(TARGET / "front.npy").astype(np.float32)).movedim(-1, 0)
    enlarged = (
        torch.nn.functional.interpolate(picture[None], (ENLARGED, ENLARGED), mode="bilinear")[0]
        .movedim(0, -1)
        .numpy()
    )
    scene = scene_of(enlarged, folder, (), None)
    found = {
        "ours": float(np.median(by_us(scene, 10).seconds)),
        "path replay": by_path_replay(scene, 1).seconds[-1],
    }
    path.write_text(json.dumps(found))
    return found


def flat_error(density: Array, truth: Array) -> float:
    """The relative L1 error of the density's sum along z."""
    return float(
        np.abs(project(density, 0, 1) - project(truth, 0, 1)).sum() / project(truth, 0, 1).sum()
    )


def table(entries: list[Entry], enlarged: dict[str, float], truth: Array) -> str:
    """The table of the page."""
    base = {
        entry.case: float(np.median(entry.found.seconds))
        for entry in entries
        if entry.name == "ours"
    }
    lines = []
    for entry in entries:
        (times, tv), last, pace = (
            entry.case,
            max(entry.errors),
            float(np.median(entry.found.seconds)),
        )
        shown, novel = entry.errors[last]
        density = entry.found.densities[last]
        found = (
            f"{np.abs(density - truth).sum() / truth.sum():.2f} | {flat_error(density, truth):.2f}"
        )
        words = "none" if tv == 0 else "default"
        figures = (
            f"{pace:.2g} | {pace / base[entry.case]:.1f} | {shown:.1e} | {novel:.1e} | {found}"
        )
        lines.append(f"| {96 // times}^2 | {words} | {entry.name} | {figures} |\n")
    lines += [
        f"| {ENLARGED}^2 | default | {name} | {pace:.2g} | {pace / enlarged['ours']:.1f} | | | | "
        "|\n"
        for name, pace in enlarged.items()
    ]
    return TOP + "".join(lines)


def draw(entries: list[Entry], truth: Array, path: Path) -> None:
    """Writes the picture: for each case errors against iterations and seconds, and the density
    along z.
    """
    cases = list(dict.fromkeys(entry.case for entry in entries))
    figure, axes = plt.subplots(
        len(cases),
        6,
        figsize=(12.5, 2.6 * len(cases)),
        layout="constrained",
        width_ratios=(1.5, 1.5, 1, 1, 1, 1),
    )
    full = float(project(truth, 0, 1).max())
    for row, case in zip(axes, cases, strict=True):
        for axis in row[2:]:
            axis.axis("off")
        some = [entry for entry in entries if entry.case == case]
        for index, entry in enumerate(some):
            _curves(row[:2], entry, f"C{list(CONTENDERS).index(entry.name)}")
            show(row[3 + index], project(entry.found.densities[max(entry.errors)], 0, 1), full)
        for axis, title in zip(
            row[2:], ["truth", *(entry.name.replace(", ", ",\n") for entry in some)], strict=False
        ):
            axis.axis("on")
            axis.set_title(title, fontsize=8)
        show(row[2], project(truth, 0, 1), full)
        row[0].set_ylabel(
            f"{96 // case[0]} x {96 // case[0]} pixels,\n{'no' if case[1] == 0 else 'with'} total "
            "variation",
            fontsize=8,
        )
        row[0].legend(fontsize=5)
    axes[0, 0].set_title(
        "loss of its own (line), error\nby path tracing (dots); iteration", fontsize=8
    )
    axes[0, 1].set_title("the same against seconds", fontsize=8)
    save(figure, path)


def _curves(axes: list[plt.Axes], entry: Entry, color: str) -> None:
    seconds = np.cumsum(entry.found.seconds)
    at = sorted(entry.errors)
    judged = [entry.errors[iteration][0] for iteration in at]
    axes[0].semilogy(
        range(1, len(seconds) + 1), entry.found.losses, color=color, label=entry.name, linewidth=1
    )
    axes[0].semilogy(at, judged, "o", color=color, markersize=4)
    axes[1].loglog(seconds, entry.found.losses, color=color, linewidth=1)
    axes[1].loglog(seconds[np.array(at) - 1], judged, "o", color=color, markersize=4)
    for axis in axes:
        axis.tick_params(labelsize=6)


def remake(folder: Path, iterations: int = 40, is_kept: bool = False) -> None:
    """Draws the picture and rewrites the table."""
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    truth, judge = read_field(SHAPES / "cloud.npz", "density").values, Judge.of(folder)
    entries = [
        run((times, tv), name, folder, iterations, judge, is_kept)
        for times, tv, names in CASES
        for name in names
    ]
    draw(entries, truth, PICTURES / "fig07.png")
    text = table(entries, paces(folder, is_kept), truth)
    keep("fig07", "python benchmarks/paper_path_replay.py", text.splitlines())


def main() -> None:
    """Remakes Fig. 7."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "runs" / "paper" / "fig07")
    parser.add_argument("--iterations", type=int, default=40)
    parser.add_argument("--keep", action="store_true", help="do not run again what has been run")
    given = parser.parse_args()
    if lacking := why_not():
        raise SystemExit(f"Fig. 7 {lacking}")
    remake(given.output, given.iterations, given.keep)


if __name__ == "__main__":
    main()
