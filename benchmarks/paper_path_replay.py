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
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib
import numpy as np
import torch
from figures import keep
from paper_figures import CONFIGS, PICTURES, ROOT, SHAPES, Array, project, save, show
from path_replay import DENSITY, HEADROOM, Replay, why_not
from torch.nn.functional import interpolate

from ddrecon.io.volumes.table import read_field
from ddrecon.reconstruct.frame import Frame
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reference.trace import open_tracer
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene

matplotlib.use("Agg")
import matplotlib.pyplot as plt

CONFIG, TARGET = CONFIGS / "fig07.yaml", ROOT / "data/paper/fig07/front.npy"
PATHS, RATE, RAYS = 64, 0.1, 4
"""Paths and rays a pixel of theirs and of ours; learning rate at first."""
FINAL_RATE = 0.2
"""The part to which it falls."""
LARGE = 256
"""Pixels a side of the picture that is only timed: the smallest of the paper's."""
JUDGED_AT = (5, 15, 40)
JUDGING, CONVERGED = 64, 512
"""Paths a pixel of each trace that judges, and of each target."""
CONTENDERS = {
    "ours": (None, ()),
    "ours, one round": (None, ("diffusion.transport_rounds=1",)),
    "path replay": (1.0, ()),
    "path replay, higher majorant": (HEADROOM, ()),
}
"""How many times the densest path replay's majorant is, None of us; and overrides."""
CASES = (
    (3, 0.0, ("ours", "path replay", "path replay, higher majorant")),
    (2, None, ("ours", "ours, one round", "path replay")),
)
"""How much larger pixels are, the weight of the total variation (None: its default), and who
competes.
"""
HEAD = "pixels", "total variation", "", "seconds an iteration", "times ours"
HEAD += "error, shown view", "novel view", "L1 error of density", "along z"


@dataclass(frozen=True)
class Run:
    """Seconds and loss of each iteration; densities [z, y, x] and squared errors after some.

    In the end there is the error of the novel view, too. It is of pixels `times` as large, and of
    the total variation `tv`.
    """

    times: int
    tv: float | None
    name: str
    seconds: Array
    losses: Array
    densities: dict[int, Array]
    errors: dict[int, Array]


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


def reconstruct(
    scene: Scene, iterations: int, headroom: float | None
) -> tuple[list[float], list[float], dict[int, Array]]:
    """Seconds and losses of iterations, and the density after some; losses of path replay are
    those of noisy pictures.
    """
    if headroom is None:
        frame = Frame(scene, iterations)
        frame.enter(len(frame.problem.factors) - 1)
        (parameter,) = frame.parameters
    else:
        import drjit

        settings = scene.optimize.parameters["density"]
        parameter = Parameter("density", settings, scene.starts["density"], scene.volume.grid)
        target, replay = scene.views[0].image.movedim(0, -1), Replay.of(scene, headroom)
        power, wanted = float(target.square().mean()), replay.module.TensorXf(target.numpy())
    steps, seconds, losses, densities = Steps(parameter, iterations), [], [], {}
    for iteration in range(iterations):
        start, density = time.process_time(), parameter.value.detach()
        if headroom is None:
            objective = frame.evaluate().objective
            steps.step(objective.slopes(1.0)["density"])
            losses.append(objective.total(1.0))
        else:
            replay.set_density(density)
            loss, (gradient,) = replay.gradients(
                lambda image: drjit.mean(drjit.square(image - wanted), axis=None),
                [replay.name(DENSITY)],
                iteration,
                PATHS,
            )
            penalty, smooth = parameter.penalty() or (0.0, 0.0)
            steps.step(replay.by_density(gradient, density) / power + smooth)
            losses.append(loss / power + float(penalty))
        seconds.append(time.process_time() - start)
        if iteration + 1 in JUDGED_AT:
            densities[iteration + 1] = parameter.value.detach().numpy().copy()
    return seconds, losses, densities


def enlarge(picture: Array, times: int) -> Array:
    """`picture` [h, w, 3] in pixels `times` times as large."""
    height, width = (size // times for size in picture.shape[:2])
    parts = picture[: height * times, : width * times].reshape(height, times, width, times, 3)
    mean: Array = parts.mean((1, 3))
    return mean


def scene_of(picture: Array, folder: Path, overrides: tuple[str, ...], tv: float | None) -> Scene:
    """The scene to reconstruct from `picture` [h, w, 3] alone."""
    path = folder / f"front_{len(picture)}.npy"
    np.save(path, picture)
    keys = [f"render.samples_per_pixel={RAYS}", f"views.0.image={path.resolve()}"]
    keys += [] if tv is None else [f"optimize.parameters.density.tv={tv}"]
    scene = load_scene(CONFIG, overrides=[*keys, *overrides])
    return replace(scene, views=scene.views[:1])


def trace(scene: Scene, density: Array, paths: int, seed: int, views: int) -> list[list[Array]]:
    """Two pictures of each of the first `views`, each `seed` and those after it with paths of its
    own.
    """
    scene = replace(scene, volume=replace(scene.volume, density=torch.from_numpy(density)))
    tracer = open_tracer(scene, scene.views, threads=torch.get_num_threads())
    return [
        [tracer.trace(view, seed + 2 * view + turn, paths) for turn in range(2)]
        for view in range(views)
    ]


def judge(truth: Scene, folder: Path, density: Array, times: int, views: int) -> list[float]:
    """The squared error of each of the first `views`, in pixels `times` as large, without noise.

    Targets, two of each view of `truth` with noise of their own, are traced unless `folder` has
    them.
    """
    path = folder / "targets.npy"
    if not path.exists():
        true = truth.volume.density.numpy()
        np.save(path, trace(truth, true, CONVERGED, 1000, len(truth.views)))
    squares = []
    for pair in zip(trace(truth, density, JUDGING, 0, views), np.load(path), strict=False):
        first, second = (enlarge(a - b, times) for a, b in zip(*pair, strict=True))
        squares.append(float((first * second).mean()))
    return squares


def run(
    times: int, tv: float | None, name: str, folder: Path, iterations: int, is_kept: bool
) -> Run:
    """Runs a contender, or reads what it did."""
    words = (times, "default" if tv is None else tv, *name.replace(",", "").split())
    path = folder / f"{'_'.join(map(str, words))}.npz"
    if not (is_kept and path.exists()):
        headroom, overrides = CONTENDERS[name]
        picture = enlarge(np.load(TARGET).astype(np.float32), times)
        print(f"{len(picture)} pixels, total variation {tv}, {name}", flush=True)
        scene = scene_of(picture, folder, overrides, tv)
        seconds, losses, densities = reconstruct(scene, iterations, headroom)
        true = f"volume.density={{file: {SHAPES / 'cloud.npz'}}}"
        truth, arrays = load_scene(CONFIG, overrides=[true]), dict[str, object]()
        for at, density in densities.items():
            views = 2 if at == iterations else 1
            arrays[f"errors_{at}"] = judge(truth, folder, density, times, views)
            arrays[f"density_{at}"] = density
        np.savez_compressed(path, seconds=seconds, losses=losses, **arrays)
    stored = np.load(path)
    at = [int(key.removeprefix("density_")) for key in stored if key.startswith("density_")]
    densities, errors = ({i: stored[f"{key}_{i}"] for i in at} for key in ("density", "errors"))
    return Run(times, tv, name, stored["seconds"], stored["losses"], densities, errors)


def paces(folder: Path, is_kept: bool) -> dict[str, float]:
    """Seconds of an iteration at `LARGE` pixels a side, the picture being enlarged and good for
    nothing else.
    """
    path = folder / "paces.json"
    if not (is_kept and path.exists()):
        picture = torch.from_numpy(np.load(TARGET).astype(np.float32)).movedim(-1, 0)
        enlarged = interpolate(picture[None], (LARGE, LARGE), mode="bilinear")[0].movedim(0, -1)
        scene = scene_of(enlarged.numpy(), folder, (), None)
        ours, theirs = (reconstruct(scene, *how)[0] for how in ((10, None), (1, 1.0)))
        seconds = {"ours": float(np.median(ours)), "path replay": theirs[-1]}
        path.write_text(json.dumps(seconds))
    return dict(json.loads(path.read_text()))


def table(runs: list[Run], enlarged: dict[str, float], truth: Array) -> list[str]:
    """The table of the page."""
    rows = [HEAD, ("---",) * len(HEAD)]
    base = {entry.times: np.median(entry.seconds) for entry in runs if entry.name == "ours"}
    for entry in runs:
        last, pace = max(entry.errors), np.median(entry.seconds)
        density, (shown, novel) = entry.densities[last], entry.errors[last]
        flat, true = project(density, 0, 1), project(truth, 0, 1)
        row = [f"{96 // entry.times}^2", "none" if entry.tv == 0 else "default", entry.name]
        row += [f"{pace:.2g}", f"{pace / base[entry.times]:.1f}", f"{shown:.1e}", f"{novel:.1e}"]
        row += [f"{np.abs(density - truth).sum() / truth.sum():.2f}"]
        rows.append((*row, f"{np.abs(flat - true).sum() / true.sum():.2f}"))
    for name, pace in enlarged.items():
        timed = f"{pace:.2g}", f"{pace / enlarged['ours']:.1f}"
        rows.append((f"{LARGE}^2", "default", name, *timed, "", "", "", ""))
    return [f"| {' | '.join(row)} |" for row in rows]


def draw(runs: list[Run], truth: Array, path: Path) -> None:
    """Writes the picture: for each case errors against iterations and seconds, and the density
    along z.
    """
    size, widths = (12.5, 2.6 * len(CASES)), (1.5, 1.5, 1, 1, 1, 1)
    figure, axes = plt.subplots(
        len(CASES), 6, figsize=size, layout="constrained", width_ratios=widths
    )
    flat = project(truth, 0, 1)
    for row, (times, tv, _) in zip(axes, CASES, strict=True):
        for axis in row[2:]:
            axis.axis("off")
        entries = [entry for entry in runs if entry.times == times]
        maps = {"truth": flat}
        for entry in entries:
            _draw_curves(row[:2], entry, f"C{list(CONTENDERS).index(entry.name)}")
            density = entry.densities[max(entry.errors)]
            maps[entry.name.replace(", ", ",\n")] = project(density, 0, 1)
        for axis, (title, values) in zip(row[2:], maps.items(), strict=False):
            axis.axis("on")
            axis.set_title(title, fontsize=8)
            show(axis, values, float(flat.max()))
        smoothing = f"{'no' if tv == 0 else 'with'} total variation"
        row[0].set_ylabel(f"{96 // times} x {96 // times} pixels,\n{smoothing}", fontsize=8)
        row[0].legend(fontsize=5)
    title = "loss of its own (line), error\nby path tracing (dots); iteration"
    axes[0, 0].set_title(title, fontsize=8)
    axes[0, 1].set_title("the same against seconds", fontsize=8)
    save(figure, path)


def _draw_curves(axes: list[plt.Axes], entry: Run, color: str) -> None:
    seconds, at = np.cumsum(entry.seconds), sorted(entry.errors)
    judged = [entry.errors[iteration][0] for iteration in at]
    line = {"color": color, "linewidth": 1}
    axes[0].semilogy(range(1, len(seconds) + 1), entry.losses, label=entry.name, **line)
    axes[0].semilogy(at, judged, "o", color=color, markersize=4)
    axes[1].loglog(seconds, entry.losses, **line)
    axes[1].loglog(seconds[np.array(at) - 1], judged, "o", color=color, markersize=4)
    for axis in axes:
        axis.tick_params(labelsize=6)


def remake(folder: Path, iterations: int = 40, is_kept: bool = False) -> None:
    """Draws the picture and rewrites the table."""
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    truth = read_field(SHAPES / "cloud.npz", "density").values
    runs = [
        run(times, tv, name, folder, iterations, is_kept)
        for times, tv, names in CASES
        for name in names
    ]
    draw(runs, truth, PICTURES / "fig07.png")
    rows = table(runs, paces(folder, is_kept), truth)
    keep("fig07", "python benchmarks/paper_path_replay.py", rows)


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
