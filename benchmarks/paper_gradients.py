"""Fig. 8 of docs/experiments.md: our derivative images beside differences of path-traced ones.

    python benchmarks/paper_gradients.py [-o FOLDER] [--paths 8192] [--replay-paths 512]

Every cell's density, or its absorption, changes by the same amount. Derivatives are taken in the
middle between two scenes that Mitsuba traces: the cloud as it is, and with a little more density
everywhere; for absorption, less and more. Where DRJIT_LIBLLVM_PATH is set, path replay's are shown
too, of pixels twice as large, one by one. Pictures that are there already are not traced again.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from figures import keep
from numpy.typing import NDArray
from paper_figures import (
    CONFIGS,
    PICTURES,
    ROOT,
    SHAPES,
    Array,
    as_options,
    ddrecon,
    save,
    show,
    show_signed,
)
from path_replay import ALBEDO, DENSITY, Replay, why_not

from ddrecon.io.volumes.table import read_field, write_field
from ddrecon.scene_file.build import load_scene

matplotlib.use("Agg")
import matplotlib.pyplot as plt

CONFIG, CLOUD, PICTURE = CONFIGS / "fig08.yaml", SHAPES / "cloud.npz", PICTURES / "fig08.png"
PATHS, REPLAY_PATHS = 8192, 512
LARGER = 2
"""Path replay's pixels are so many times as large."""
HAZE, ABSORPTION = 0.03, 1.0
"""Differences of density, and of sigma_a [1/u], between the two scenes that are traced."""
ENLARGED = 4
"""Errors are shown so many times brighter than the derivatives."""
MODELS = {
    "printed": ("diffusion.scheme=printed",),
    "0 rounds": ("diffusion.transport_rounds=0",),
    "2 rounds": ("diffusion.transport_rounds=2",),
}
"""The paper's own scheme, and ours without and with transport rounds, as overrides."""
TOP = "| by | what | noise | error | in the regions | correlation |", "|---|---|---|---|---|---|"
TOP_PARTS = "| by | what | light scattered more than once | its derivative |", "|---|---|---|---|"


@dataclass(frozen=True)
class Change:
    """The scenes `before`, `between` and `after` as overrides; `parameter` changes by `amount` in
    all, from the first to the last.
    """

    parameter: str
    amount: float
    before: str
    between: str
    after: str


def changes(folder: Path) -> list[Change]:
    """Both changes, with the volumes they need in `folder`."""
    cloud = read_field(CLOUD, "density")
    names = {"before": 0.0, "between": HAZE / 2, "after": HAZE}
    for name, haze in names.items():
        write_field(
            folder / f"{name}.npz", "density", cloud.values + np.float32(haze), cloud.bounds
        )
    hazy = [f"volume.density={{file: {(folder / f'{name}.npz').resolve()}}}" for name in names]
    return [
        Change("density", HAZE, *hazy),
        Change(
            "sigma_a",
            ABSORPTION,
            *(f"volume.sigma_a={1 + ABSORPTION * part}" for part in (-0.5, 0, 0.5)),
        ),
    ]


def trace_derivative(change: Change, folder: Path, paths: int) -> tuple[Array, float]:
    """The derivative image [h, w] from path tracing, and the standard error of its pixels (root
    mean square).
    """
    pictures, variance = [], 0.0
    for name, override in (("before", change.before), ("after", change.after)):
        output = folder / f"{change.parameter}_{name}"
        if not (output / "reference.json").exists():
            ddrecon(
                "reference", CONFIG, "-o", output, "--views", "--spp", str(paths), "-D", override
            )
        picture = np.load(output / "front.npy").mean(-1)
        noise = json.loads((output / "reference.json").read_text())["views"]["front"]["noise"]
        variance += noise**2 * float((picture**2).mean())
        pictures.append(picture)
    return (pictures[1] - pictures[0]) / change.amount, variance**0.5 / change.amount


def replay_derivative(change: Change, folder: Path, paths: int) -> tuple[Array, float]:
    """The derivative image [h, w] by path replay, in larger pixels, and the standard error of its
    pixels (root mean square).

    Each pixel is a picture of its own, one camera being shifted from one to the next: a gradient
    has but one loss.
    """
    path = folder / f"{change.parameter}_replay.npy"
    if not path.exists():
        np.save(path, [_replay_once(change, paths, seed) for seed in range(2)])
    both = np.load(path)
    return both.mean(0), float(np.sqrt(((both[0] - both[1]) ** 2).mean()) / 2)


def _replay_once(change: Change, paths: int, seed: int) -> Array:
    import drjit

    scene = load_scene(CONFIG, overrides=[change.between])
    (view,), (height, width) = scene.views, scene.views[0].camera.resize(LARGER).size
    small = replace(view.camera, size=(1, 1), half_width=view.camera.half_width / width)
    replay, volume = Replay.of(replace(scene, views=[replace(view, camera=small)])), scene.volume
    names, image = (
        [replay.name(ending) for ending in (DENSITY, ALBEDO)],
        np.zeros((height, width), np.float32),
    )
    for row, column in np.ndindex(height, width):
        replay.parameters[replay.name("principal_point_offset_x")] = column + 0.5 - width / 2
        replay.parameters[replay.name("principal_point_offset_y")] = row + 0.5 - height / 2
        pixel = seed * height * width + row * width + column
        _, (by_density, by_albedo) = replay.gradients(
            lambda picture: drjit.mean(picture, axis=None), names, pixel, paths
        )
        if change.parameter == "density":
            image[row, column] = by_density.sum()
        else:
            sigma_a, sigma_s = float(volume.sigma_a), float(volume.sigma_s)
            by_extinction = float(
                replay.by_density(by_density, volume.density).mul(volume.density).sum()
            ) / (sigma_a + sigma_s)
            image[row, column] = (
                by_extinction - by_albedo.sum() * sigma_s / (sigma_a + sigma_s) ** 2
            )
    return image


def differentiate(change: Change, folder: Path, model: str) -> dict[str, Array]:
    """By one of `MODELS`: the `derivative` of the image [h, w]; what is seen of light scattered at
    most once, `single`, and more often, `multiple`; and the `slope` of each.
    """
    output = folder / f"{change.parameter}_{model[0]}"
    options = ["--components", "--gradient", change.parameter]
    options += as_options([change.between, *MODELS[model]])
    ddrecon("render", CONFIG, "-o", output, *options)

    def read(name: str) -> Array:
        mean: Array = np.load(output / f"front.{name}.npy").mean(-1)
        return mean

    once = read("gradient.single") + read("gradient.reduced")
    often = read("gradient.multiple")
    parts = {"single": read("single"), "multiple": read("multiple"), "derivative": once + often}
    return parts | {"single slope": once, "multiple slope": often}


def regions(folder: Path) -> dict[str, NDArray[np.bool_]]:
    """Pixels [h, w] by what part of a light behind the cloud they would let through."""
    black = ["volume.sigma_s=0", "volume.sigma_a=12", "lights=[{type: ambient, radiance: 1}]"]
    ddrecon("render", CONFIG, "-o", folder / "through", *as_options(black))
    through = np.load(folder / "through" / "front.npy").mean(-1)
    return {
        "thick": through < 0.2,
        "thin": (through >= 0.2) & (through < 0.95),
        "empty": through >= 0.95,
    }


def relative_error(image: Array, truth: Array) -> float:
    """The root mean square error of `image` relative to `truth`, whose noise it includes."""
    return float(np.sqrt(((image - truth) ** 2).mean() / (truth**2).mean()))


def coarsen(image: Array) -> Array:
    """`image` [h, w] in pixels `LARGER` times as large."""
    height, width = (side // LARGER for side in image.shape)
    mean: Array = image.reshape(height, LARGER, width, LARGER).mean((1, 3))
    return mean


def remake(folder: Path, paths: int = PATHS, replay_paths: int = REPLAY_PATHS) -> None:
    """Draws the picture and rewrites both tables."""
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    seen, lines, parts = regions(folder), [*TOP], [*TOP_PARTS]
    coarse = {name: coarsen(region.astype(np.float32)) > 0.5 for name, region in seen.items()}
    figure, axes = plt.subplots(2, 9, figsize=(15, 4), layout="constrained")
    for row, change in zip(axes, changes(folder), strict=True):
        truth, noise = trace_derivative(change, folder, paths)
        full = float(np.quantile(np.abs(truth), 0.99))
        row[0].set_ylabel(f"by {change.parameter}")
        show_signed(row[0], truth, full, "differences of\npath tracing")
        for axis in row[1:]:
            axis.axis("off")
        images = {name: differentiate(change, folder, name) for name in MODELS}
        for column, (name, image) in enumerate(images.items(), 2):
            lines.append(line(change, name, image["derivative"], truth, noise, seen))
            both = row[column], row[column + 4]
            _draw_comparison(both, image["derivative"], truth, full, f"ours, {name}")
        parts += shares(change, images, folder, truth, seen["thick"])
        if why_not() is None:
            image, noise = replay_derivative(change, folder, replay_paths)
            name, truth = "path replay, larger pixels", coarsen(truth)
            lines.append(line(change, name, image, truth, noise, coarse))
            _draw_comparison((row[1], row[5]), image, truth, full, "path replay")
    save(figure, PICTURE)
    command = "python benchmarks/paper_gradients.py"
    keep("fig08", command, lines)
    keep("fig08_parts", f"{command} (parts)", parts)


def line(
    change: Change,
    name: str,
    image: Array,
    truth: Array,
    noise: float,
    seen: dict[str, NDArray[np.bool_]],
) -> str:
    """A line of the table: errors of `image`, and the `noise` there is in truth, or in it."""
    errors = ((region, relative_error(image[at], truth[at])) for region, at in seen.items())
    words = ", ".join(f"{region} {error:.3f}" for region, error in errors)
    alike = np.corrcoef(image.ravel(), truth.ravel())[0, 1]
    numbers = noise / np.sqrt((truth**2).mean()), relative_error(image, truth)
    cells = [change.parameter, name, *(f"{n:.3f}" for n in numbers), words, f"{alike:.3f}"]
    return f"| {' | '.join(cells)} |"


def shares(
    change: Change,
    images: dict[str, dict[str, Array]],
    folder: Path,
    truth: Array,
    where: NDArray[np.bool_],
) -> list[str]:
    """Lines of the other table: light scattered more than once, as parts of what path tracing has,
    in the pixels `where`.
    """
    ends = [
        np.load(folder / f"{change.parameter}_{name}" / "front.npy").mean(-1)
        for name in ("before", "after")
    ]
    light, slope = ((ends[0] + ends[1]) / 2)[where].mean(), truth[where].mean()
    rows = []
    for name, found in images.items():
        multiple, single, multiple_slope, single_slope = (
            found[kind][where].mean()
            for kind in ("multiple", "single", "multiple slope", "single slope")
        )
        parts = multiple / (light - single), multiple_slope / (slope - single_slope)
        rows.append(f"| {change.parameter} | {name} | {parts[0]:.3f} | {parts[1]:.3f} |")
    return rows


def _draw_comparison(
    axes: tuple[Any, Any], image: Array, truth: Array, full: float, title: str
) -> None:
    for axis in axes:
        axis.axis("on")
    show_signed(axes[0], image, full, title)
    show(axes[1], np.abs(image - truth), full / ENLARGED, "inferno")
    words = f"{ENLARGED} x |error|,\n{title}: {relative_error(image, truth):.2f}"
    axes[1].set_title(words, fontsize=8)


def main() -> None:
    """Remakes Fig. 8."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "runs" / "paper" / "fig08")
    parser.add_argument("--paths", type=int, default=PATHS)
    parser.add_argument("--replay-paths", type=int, default=REPLAY_PATHS)
    given = parser.parse_args()
    remake(given.output, given.paths, given.replay_paths)


if __name__ == "__main__":
    main()
