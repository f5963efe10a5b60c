"""Makes the pictures of README.md and docs/gallery.md from runs of configs/.

    python docs/gallery_figures.py RUNS [NAME]...

RUNS/NAME is the folder of `ddrecon optimize configs/NAME.yaml`; `uses` is the README's picture. A
figure has a picture, renders of the result by the same camera and from other sides, under another
light, and middle slices of the fields that were optimized.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import matplotlib.pyplot as plt
import numpy as np
import torch
from numpy.typing import NDArray

import ddrecon
from ddrecon.io.volumes.table import read_field
from ddrecon.pictures import encode

DOCS = Path(__file__).parent
Pixels = NDArray[np.float32]


@dataclass(frozen=True)
class Figure:
    """A view and its size in pixels, lights of the renders from around, the fields in slices, and
    their axis across.
    """

    view: str
    size: tuple[int, int]
    lights: tuple[str, ...] = ()
    fields: tuple[str, ...] = ("density",)
    axis: int = 0


def sun(direction: str, irradiance: str) -> str:
    return f"{{type: directional, direction: {direction}, irradiance: {irradiance}}}"


SKY = "{type: ambient, radiance: [0.1, 0.13, 0.2]}"
FIGURES = {
    "plume": Figure("test_10", (512, 512), (sun("[1, -1, 0]", "4"),)),
    "capture": Figure("held_out", (400, 600), (sun("[-1, -0.5, -1]", "5"), SKY)),
    "smoke_sky": Figure("novel", (512, 512), (sun("[1, -1, 0]", "4"),)),
    "cumulus_field": Figure(
        "across", (512, 512), (sun("[1, 0.3, -0.5]", "[4, 3.2, 2.8]"), SKY), axis=1
    ),
    "satellite": Figure("across", (512, 512), axis=1),
    "fire": Figure("test_8", (384, 512), fields=("density", "emission")),
    "photograph": Figure("front", (512, 512), (sun("[2, -2, -1]", "[3, 3.2, 3.6]"), SKY)),
    "phantom": Figure("corner_0", (512, 512), fields=("sigma_a",)),
}
"""By the name of a config."""
USES = {
    "capture": "a smoke, by five cameras",
    "cloud": "a film's cloud, lit anew",
    "cumulus_field": "clouds, by a satellite",
    "fire": "a fire and its smoke",
}
"""What the README's picture says that ddrecon is for, above the seconds of the run."""


def render(scene: Path, folder: Path, *options: str) -> list[Pixels]:
    """The images `[h, w, 3]` that `ddrecon render` writes into `folder`, in their order."""
    command = [sys.executable, "-m", "ddrecon", "render", str(scene), "-q", "-o", str(folder)]
    subprocess.run([*command, "--overwrite", *options], check=True, stdout=subprocess.DEVNULL)
    return [np.load(path) for path in sorted(folder.glob("*.npy"))]


def look_around(run: Path, figure: Figure) -> list[Pixels]:
    """Renders of a run from five sides, under the figure's lights."""
    size = ["--view", figure.view, "--size", *map(str, figure.size)]
    lights = [word for light in figure.lights for word in ("--light", light)]
    return render(run, run.with_name(f"{run.name}_around"), *size, "--ring", "5", *lights)


def display(image: Pixels, white: float | None = None) -> Pixels:
    """`image` in sRGB; white is its brightest pixels but for one in a thousand."""
    white = white or float(np.quantile(image, 0.999))
    return encode(np.clip(image / white, 0, 1))


def middle(run: Path, name: str, axis: int) -> Pixels:
    """The middle slice of a field `[z, y, x]` across an axis (0: z, 1: y), its first row on top."""
    values = read_field(run / "volumes" / f"{name}.npz", name).values
    values = values.mean(-1) if values.ndim == 4 else values
    return values.take(values.shape[axis] // 2, axis)[::-1]


def draw(panels: list[tuple[str, Pixels]], path: Path) -> None:
    """Writes labeled pictures side by side, all of one height."""
    widths = [image.shape[1] / image.shape[0] for _, image in panels]
    figure, axes = plt.subplots(
        1, len(panels), figsize=(3 * sum(widths), 3.25), width_ratios=widths, layout="constrained"
    )
    for axis, (title, image) in zip(axes, panels, strict=True):
        axis.imshow(image, cmap="gray", interpolation="bicubic", aspect="auto")
        axis.set_title(title, fontsize=9)
        axis.axis("off")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def draw_run(run: Path, figure: Figure) -> None:
    """Writes the figure of a run into docs/pictures/gallery/."""
    view = ddrecon.load_scene(run / "result.yaml").view(figure.view)
    assert isinstance(view.image, torch.Tensor)
    target = view.image.permute(1, 2, 0).numpy()
    white = float(np.quantile(target, 0.999))
    options = ["--view", figure.view, "--size", *map(str, figure.size)]
    (seen,) = render(run, run.with_name(f"{run.name}_seen"), *options)
    sides = look_around(run, figure)
    kind = "held-out picture" if view.is_test else "picture"
    panels = [
        (f"{kind}, {target.shape[1]} x {target.shape[0]}", display(target, white)),
        ("our render", display(seen, white)),
        *(("from another side", display(side)) for side in (sides[1], sides[3])),
        *((f"{name}, middle slice", middle(run, name, figure.axis)) for name in figure.fields),
    ]
    draw(panels, DOCS / "pictures" / "gallery" / f"{run.name}.png")


def draw_uses(runs: Path) -> None:
    """Writes docs/pictures/uses.png, the README's picture of what ddrecon is for."""
    panels = []
    for name, text in USES.items():
        if name == "cloud":
            image = iio.imread(DOCS / "pictures" / "cloud.png")[..., :3] / np.float32(255)
            stages = json.loads((runs / name / "render.json").read_text())["seconds"]
            seconds = stages["light"] + sum(stages["views"].values())
        else:
            image = display(look_around(runs / name, FIGURES[name])[1])
            seconds = json.loads((runs / name / "summary.json").read_text())["seconds"]
        panels.append((f"{text}, {seconds:.0f} s", image))
    draw(panels, DOCS / "pictures" / "uses.png")


def main(runs: Path, *names: str) -> None:
    """Draws what is asked for, or all."""
    for name in names or (*FIGURES, "uses"):
        if name == "uses":
            draw_uses(runs)
        else:
            draw_run(runs / name, FIGURES[name])


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
