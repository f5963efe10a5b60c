"""What the paper's experiments found: what to draw of a run, beside the truth, and the words for
the table.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import yaml
from paper_figures import Array, Pair, draw, draw_derivatives, project, read_log
from paper_page import CONFIGS, PICTURES, SHAPES, as_options, ddrecon, rewrite_table

from ddrecon.grid import Grid
from ddrecon.io.images.table import read_image
from ddrecon.io.volumes.table import read_field
from ddrecon.reconstruct.levels import resample

NAMES_13 = {
    "default": "default",
    "one_round": "one round",
    "half": "half the cells, default",
    "half_one_round": "half the cells, one round",
    "half_printed": "half the cells, printed",
}
TOP_13 = (
    "| model | iterations | seconds | PSNR shown, novel | L1 error of the density | in the "
    "lowest third | density there, in truth 1 |\n"
    "|---|---|---|---|---|---|---|\n"
)


@dataclass(frozen=True)
class Run:
    """A finished run of the config `name` in `folder`."""

    name: str
    folder: Path

    def field(self, name: str) -> Array:
        """The reconstructed field `name` [z, y, x] or [z, y, x, 3]."""
        return read_field(self.folder / "volumes" / f"{name}.npz", name).values

    def number(self, name: str) -> float | list[float]:
        """The found number, or color, of that name."""
        found: float | list[float] = json.loads((self.folder / "parameters.json").read_text())[name]
        return found

    def view(self, name: str, title: str) -> Pair:
        """The view `name`, as the scene has it and as rendered."""
        scene = yaml.safe_load((self.folder / "scene.yaml").read_text())
        (image,) = (view.get("image") for view in scene["views"] if view["name"] == name)
        ours = read_image(self.folder / "views" / f"{name}.npy").pixels
        return Pair(title, None if image is None else read_image(self.folder / image).pixels, ours)


Runs = Mapping[str, Run]
Shown = Callable[[Runs], tuple[list[Pair], str]]


def first(runs: Runs) -> Run:
    """The first of `runs`, the one the table tells of."""
    return next(iter(runs.values()))


def shape(name: str, like: Array, field: str = "density") -> Array:
    """A field of the true volume `name`, in cells as small as those of `like` [z, y, x, ...]."""
    values = read_field(SHAPES / f"{name}.npz", field)
    grid = Grid(like.shape[:3], *(tuple(corner[::-1]) for corner in values.bounds))
    found = torch.from_numpy(values.values)
    moved = found if found.ndim == 3 else found.movedim(-1, 0)
    carried = resample(moved, grid)
    return (carried if found.ndim == 3 else carried.movedim(0, -1)).numpy()


def relative_l1(ours: Array, truth: Array) -> float:
    """The relative L1 error."""
    return float(np.abs(ours - truth).sum() / truth.sum())


def densities(run: Run, truth: Array) -> list[Pair]:
    """Density seen from the front and from the side, and its middle slice, beside `truth`."""
    ours = run.field("density")
    pairs = [
        Pair(f"density along {name}", project(truth, axis, 1), project(ours, axis, 1))
        for axis, name in ((0, "z"), (2, "x"))
    ]
    middle = truth.shape[0] // 2
    return [*pairs, Pair("density, middle slice", truth[middle, ::-1], ours[middle, ::-1])]


def show_density(truth: str, front: str) -> Shown:
    """What to show of a run that looks for the density of the shape `truth` and was shown the view
    `front`.
    """

    def shown(runs: Runs) -> tuple[list[Pair], str]:
        run = first(runs)
        density = shape(truth, run.field("density"))
        pairs = [
            run.view(front, "a view it was shown"),
            run.view("novel", "novel view"),
            *densities(run, density),
        ]
        return (
            pairs,
            f"relative L1 error of the density {relative_l1(run.field('density'), density):.2f}",
        )

    return shown


def draw_rounds(runs: Runs) -> None:
    """Fig. 13 by other models: a picture of the densities, and a table."""
    lines, pairs = [], []
    for name, run in runs.items():
        density, log = run.field("density"), read_log(run.folder)
        true = shape("bunny", density)
        pairs.append(
            Pair(
                f"{NAMES_13[name]}:\ndensity along x",
                project(true, 2, 1),
                project(density, 2, 1),
            )
        )
        low = slice(0, len(density[0]) // 3)
        quality = f"{log['psnr'][-1]:.1f} dB, {log['test_psnr'][-1]:.1f} dB"
        parts = (
            f"{relative_l1(density, true):.3f} | {relative_l1(density[:, low], true[:, low]):.2f} "
            "| "
            f"{density[:, low].sum() / true[:, low].sum():.2f}"
        )
        lines.append(
            f"| {NAMES_13[name]} | {len(log['loss'])} | {log['seconds'][-1]:.0f} | {quality} | "
            f"{parts} |\n"
        )
    draw(PICTURES / "fig13_rounds.png", pairs, {})
    rewrite_table("paper.py fig13", TOP_13 + "".join(lines))


def draw_parts(runs: Runs) -> None:
    """Fig. 9: derivatives of pixels by density, of each part of the radiance, at the start and at
    what each run found.
    """
    images, parts = (
        [],
        {
            "single": ("reduced", "single"),
            "diffusion": ("multiple",),
            "all": ("reduced", "single", "multiple"),
        },
    )
    for name in parts:
        run, bunny = runs[name], [f"volume.density={{file: {SHAPES}/bunny.npz}}"]
        places = {"start": (CONFIGS / "fig09.yaml", bunny), "end": (run.folder, [])}
        for place, (scene, overrides) in places.items():
            folder = run.folder / f"derivative_{place}"
            ddrecon(
                "render",
                scene,
                "-o",
                folder,
                "--view",
                "front",
                "--components",
                "--gradient",
                "density",
                *as_options(overrides),
            )
            image = sum(
                np.load(folder / f"front.gradient.{part}.npy").mean(-1) for part in parts[name]
            )
            images.append(
                (f"{name}, {'at the bunny' if place == 'start' else 'in the end'}", image)
            )
    draw_derivatives(PICTURES / "fig09_derivatives.png", images)


def show_light(runs: Runs) -> tuple[list[Pair], str]:
    """The bunny, and the color of its light."""
    run = first(runs)
    words = (
        f"irradiance {round_values(run.number('lights.0.irradiance'))}, in truth [3.2, 2.1, 1.2]"
    )
    return [run.view("front", "the view it was shown"), run.view("novel", "novel view")], words


def show_derivatives(runs: Runs) -> tuple[list[Pair], str]:
    """What each part of the derivative leads to."""
    pairs = [
        run.view(view, f"{name}: {view} view")
        for name, run in runs.items()
        for view in ("front", "novel")
    ]
    losses = {name: read_log(run.folder)["loss"] for name, run in runs.items()}
    return pairs, "last loss " + ", ".join(
        f"{name} {loss[-1]:.2g}" for name, loss in losses.items()
    )


def show_optics(runs: Runs) -> tuple[list[Pair], str]:
    """Absorption and scattering coefficients in the middle of the cloud, and g."""
    run = first(runs)
    fields = [run.field(name) for name in ("sigma_a", "sigma_s")]
    density = shape("cloud", fields[0])[..., None]
    truths = [
        density * shape("cloud", field, name)
        for name, field in zip(("sigma_a", "sigma_s"), fields, strict=True)
    ]
    found = [density * field for field in fields]
    pairs = [run.view("ring_00", "a view it was shown"), run.view("novel", "novel view")]
    for title, color, truth, ours in zip(
        ("absorption, red", "scattering, green"), (0, 1), truths, found, strict=True
    ):
        pairs.append(
            Pair(f"{title}, middle slices", *(middle(field[..., color]) for field in (truth, ours)))
        )
    errors = ", ".join(
        f"{relative_l1(ours, truth):.2f}" for ours, truth in zip(found, truths, strict=True)
    )
    alone = f", alone {runs['g_alone'].number('g'):.3f}" if "g_alone" in runs else ""
    return (
        pairs,
        f"g {run.number('g'):.3f}{alone}, in truth -0.802; relative L1 error of absorption and "
        f"scattering {errors}",
    )


def show_smoke(runs: Runs) -> tuple[list[Pair], str]:
    """The colored smoke, and its coefficients in the middle."""
    run = first(runs)
    truths, found = (
        [density * sigma for sigma in sigmas]
        for density, *sigmas in (smoke_truth(run.field("density")), smoke_found(run))
    )
    pairs = [run.view("front", "the view it was shown"), run.view("novel", "novel view")]
    for title, color, truth, ours in zip(
        ("absorption, red", "scattering, green"), (0, 1), truths, found, strict=True
    ):
        pairs.append(
            Pair(
                f"{title}, along z",
                *(project(field[..., color], 0, 1) for field in (truth, ours)),
            )
        )
    errors = ", ".join(
        f"{relative_l1(ours, truth):.2f}" for ours, truth in zip(found, truths, strict=True)
    )
    return pairs, f"relative L1 error of absorption and scattering {errors}"


def smoke_truth(like: Array) -> list[Array]:
    """Density [z, y, x, 1], sigma_a and sigma_s of the colored smoke, in cells as small as those of
    `like`.
    """
    return [
        shape("smoke", like)[..., None],
        shape("smoke", like, "sigma_a"),
        shape("smoke", like, "sigma_s"),
    ]


def smoke_found(run: Run) -> list[Array]:
    """The same as `run` found them."""
    return [run.field("density")[..., None], run.field("sigma_a"), run.field("sigma_s")]


def show_four(runs: Runs) -> tuple[list[Pair], str]:
    """The smoke from all four sides, and from one that nobody knows."""
    run = first(runs)
    return [
        run.view(name, name) for name in ("front", "right", "back", "left", "novel")
    ], "no true volume"


def show_photograph(runs: Runs) -> tuple[list[Pair], str]:
    """The cloud, and what was found of its light."""
    run = first(runs)
    names = ("lights.0.irradiance", "lights.0.direction", "lights.1.radiance", "sigma_a", "sigma_s")
    words = "; ".join(f"{name} {round_values(run.number(name))}" for name in names)
    return [run.view("front", "the photograph"), run.view("novel", "novel view")], words


def middle(field: Array) -> Array:
    """The mean of the four slices of `field` [z, y, x] in the middle across z, y upwards."""
    half = field.shape[0] // 2
    mean: Array = field[half - 2 : half + 2, ::-1].mean(0)
    return mean


def round_values(values: float | list[float]) -> str:
    """Numbers to three digits."""
    return (
        f"{values:.3g}"
        if isinstance(values, float)
        else f"[{', '.join(f'{value:.3g}' for value in values)}]"
    )
