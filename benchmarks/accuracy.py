"""How far images are from path-traced ones: tables for docs/accuracy.md, in Markdown.

    python benchmarks/accuracy.py cases --references FOLDER [--only WORD] [--pictures FOLDER]
    python benchmarks/accuracy.py convergence --references FOLDER
    python benchmarks/accuracy.py order

`cases`: anisotropy, volumes, lights and cameras, by the number of transport rounds. `convergence`:
rounds, degrees and cells together. `order`: transmittance and light scattered once against
closed forms, by size of cells. The others need Mitsuba 3 (extra `reference`).
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from traced import Traced, trace

from ddrecon.bench.plume import fade, plume_density
from ddrecon.cameras import Camera, cast_rays, look_at
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.grid import Grid
from ddrecon.light.lights import AmbientLight, DirectionalLight, Light, PointLight
from ddrecon.medium.coefficients import Volume
from ddrecon.medium.phase import henyey_greenstein
from ddrecon.renderer import render, solve_light, view_components, view_image
from ddrecon.scene import Scene, View
from ddrecon.settings import DiffusionSettings, RenderSettings

Field = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Density at x, y and z, each from -0.5 to 0.5 across the box."""
Vector = tuple[float, float, float]
ROUNDS, SIZE, SAMPLES = (0, 1, 2, 4), 32, 16
FRONT, FAR, SIDE, BELOW = (0.0, 0.3, 3.2), (-2.2, 0.9, -2.2), (-2.0, -1.2, -0.5), (1.2, -1.6, 2.4)


def around(center: Vector, outer: float, width: float = 0.11) -> Field:
    """A soft ball."""

    def density(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        return fade(
            ((x - center[0]) ** 2 + (y - center[1]) ** 2 + (z - center[2]) ** 2).sqrt(),
            outer,
            width,
        )

    return density


def together(*fields: Field) -> Field:
    """The union of several, 1 - prod (1 - density)."""

    def density(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        return 1 - math.prod((1 - part(x, y, z) for part in fields), start=torch.ones(()))

    return density


def slab(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """A wavy layer 0.15 thick, with soft edges."""
    height = (y - 0.06 * torch.sin(9 * x) * torch.cos(7 * z)).abs()
    return fade(height, 0.11, 0.07) * fade(x.abs(), 0.45, 0.1) * fade(z.abs(), 0.45, 0.1)


BALL, SMALL = around((0.0, 0.0, 0.0), 0.38), around((0.22, -0.18, 0.12), 0.17, 0.06)
CLOUD = together(around((-0.13, -0.08, 0.05), 0.3), around((0.17, 0.1, -0.05), 0.25))
DEPTH_OF_BALL = 0.65
"""The integral of `BALL` across its middle, by which its optical depths are set."""


def sun(travel: Vector) -> Light:
    return DirectionalLight(torch.tensor(travel), torch.tensor([math.pi]))


def from_far(degrees: float) -> Vector:
    """The way light travels that `FAR` sees so many degrees beside the middle of the box."""
    x, y, z = (part / math.hypot(*FAR) for part in FAR)
    ahead, aside = math.cos(math.radians(degrees)), math.sin(math.radians(degrees)) * math.sqrt(0.5)
    return ahead * x + aside, ahead * y, ahead * z - aside


def ambient(radiance: float) -> Light:
    return AmbientLight(torch.tensor([radiance]))


@dataclass(frozen=True)
class Case:
    """A scene of ours: `field` in a box of sides `extent` around the origin, seen from `eye`."""

    name: str
    field: Field
    sigma_t: float
    albedo: float = 0.95
    g: float = 0.0
    lights: list[Light] = field(default_factory=lambda: [sun(SIDE)])
    eye: Vector = FRONT
    extent: Vector = (1.0, 1.0, 1.0)
    half_width: float = math.tan(math.radians(14))
    is_perspective: bool = True
    noise: float = 0.03

    def scene(self, cells: int = 48, **diffusion: Any) -> Scene:
        """This scene on `cells`^3 cells, with such diffusion settings."""
        grid = Grid.from_xyz(
            (cells,) * 3, *(tuple(sign * side for side in self.extent) for sign in (-0.5, 0.5))
        )
        z, y, x = (
            center / side
            for center, side in zip(grid.centers(torch.zeros(())), grid.extent, strict=True)
        )
        sigmas = (torch.tensor([self.sigma_t * part]) for part in (1 - self.albedo, self.albedo))
        pose = look_at(torch.tensor(self.eye), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
        camera = Camera(pose, (SIZE, SIZE), self.half_width, self.is_perspective)
        volume = Volume(
            grid, self.field(x, y, z).expand(grid.shape).contiguous(), *sigmas, torch.tensor(self.g)
        )
        settings = RenderSettings(samples_per_pixel=SAMPLES), DiffusionSettings(**diffusion)
        return Scene(volume, self.lights, [View("view", camera)], *settings)


ANISOTROPIES = (-0.8, -0.4, 0.0, 0.4, 0.8, 0.9)
CASES = (
    *(Case(f"lit from the side, g {g}", CLOUD, 25.0, g=g) for g in ANISOTROPIES),
    *(
        Case(
            f"seen against the light, g {g}",
            CLOUD,
            25.0,
            g=g,
            lights=[sun((-2.0, -0.4, -2.2))],
            eye=FAR,
        )
        for g in ANISOTROPIES
    ),
    *(
        Case(
            f"{angle} degrees from the light, g 0.8",
            CLOUD,
            25.0,
            g=0.8,
            lights=[sun(from_far(angle))],
            eye=FAR,
        )
        for angle in (45, 70)
    ),
    *(
        Case(f"lit from the eye, g {g}", CLOUD, 25.0, g=g, lights=[sun((2.0, -1.2, 2.2))], eye=FAR)
        for g in (-0.8, -0.4, 0.0, 0.4)
    ),
    *(Case(f"ball, depth {depth}", BALL, depth / DEPTH_OF_BALL, 0.99) for depth in (5, 20, 60)),
    *(
        Case(f"ball, depth 20, albedo {albedo}", BALL, 20 / DEPTH_OF_BALL, albedo)
        for albedo in (0.5, 1.0)
    ),
    Case("thin slab", slab, 60.0, 0.99, lights=[sun((-0.5, -2.0, -0.7))], eye=(0.0, 1.6, 2.8)),
    Case("small ball off center", SMALL, 60.0, 0.99),
    Case("plume, g 0.5", plume_density, 25.0, g=0.5, extent=(1.0, 1.5, 1.0), half_width=0.3),
    Case(
        "ball, point light",
        BALL,
        25.0,
        lights=[PointLight(torch.tensor([0.9, 0.7, 0.5]), torch.tensor([3.0]))],
    ),
    Case("cloud, ambient light", CLOUD, 25.0, lights=[ambient(1.0)]),
    Case("cloud, ambient light and sun", CLOUD, 25.0, lights=[ambient(0.3), sun(SIDE)]),
    Case("cloud in 2 x 0.5 x 1", CLOUD, 25.0, extent=(2.0, 0.5, 1.0), half_width=0.33),
    Case(
        "plume, parallel rays, from below",
        plume_density,
        25.0,
        eye=BELOW,
        half_width=0.7,
        is_perspective=False,
    ),
)
CONVERGING = (
    Case("cloud, g 0", CLOUD, 15.0, 0.95, noise=0.01),
    Case("ball, g 0.6", BALL, 20.0, 0.9, 0.6, noise=0.01),
)


def gray(image: Tensor) -> np.ndarray:
    return image.mean(0).double().numpy()


def image(scene: Scene) -> np.ndarray:
    with torch.no_grad():
        return gray(view_image(solve_light(scene, SolveMemory()), scene, scene.views[0].camera))


def scattered_once(scene: Scene) -> np.ndarray:
    """The image of `scene` by light that is seen unscattered or scattered once."""
    with torch.no_grad():
        parts = view_components(solve_light(scene, SolveMemory()), scene, scene.views[0].camera)
    return gray(parts.single + parts.reduced)


def row(cells: Iterable[object]) -> None:
    print(
        "|",
        " | ".join(f"{cell:.3f}" if isinstance(cell, float) else str(cell) for cell in cells),
        "|",
        flush=True,
    )


def measure_cases(references: Path, only: str, pictures: Path | None, degree: int) -> None:
    """Prints, for every case, the errors by number of rounds."""
    row(["case", "noise", "single", *(f"n = {n}" for n in ROUNDS)])
    row(["---"] * (len(ROUNDS) + 3))
    for case in CASES:
        if only not in case.name:
            continue
        whole = trace(case.scene(), references, noise=case.noise)
        once = trace(case.scene(), references, depth=2, noise=0.02)
        found = {n: image(case.scene(transport_rounds=n, degree=degree)) for n in ROUNDS}
        single = once.error(scattered_once(case.scene()))
        errors = [_visible(whole.error(picture), whole.noise) for picture in found.values()]
        row([case.name, whole.noise, _visible(single, once.noise), *errors])
        if pictures is not None:
            draw(
                pictures / f"{'_'.join(case.name.replace(',', '').split())}.png",
                whole,
                [found[n] for n in (0, 2)],
            )


def _visible(error: float, noise: float) -> str:
    """`error`, or that it is below what can be told from such noise."""
    return f"{error:.3f}" if error > noise / 3 else f"< {noise / 3:.3f}"


def measure_convergence(references: Path) -> None:
    """Prints errors by cells, degrees and rounds, against the path-traced image of the finest
    grid.
    """
    rounds = (0, 1, 2, 4, 8)
    row(["case", "noise", "cells", "degree", *(f"n = {n}" for n in rounds)])
    row(["---"] * (4 + len(rounds)))
    for case in CONVERGING:
        whole = trace(case.scene(96), references, noise=case.noise, passes=96)
        for cells, degrees in {24: (3, 5, 7), 48: (3, 5, 7), 96: (5,)}.items():
            diffusion = image(case.scene(cells, transport_rounds=0))
            for degree in degrees:
                scenes = (case.scene(cells, transport_rounds=n, degree=degree) for n in rounds[1:])
                found = [diffusion, *(image(scene) for scene in scenes)]
                row(
                    [
                        case.name,
                        whole.noise,
                        cells,
                        degree,
                        *(_visible(whole.error(item), whole.noise) for item in found),
                    ]
                )


WIDTH, PEAK, SIGMA_A, SIGMA_S, TILT = 0.1, 12.0, 0.5, 2.0, -0.3
"""A Gaussian ball: its standard deviation, density in its middle, cross sections and mean cosine.
"""


def measure_order() -> None:
    """Prints errors of transmittance and of light scattered once for a Gaussian ball, and the slope
    to the next row.
    """
    expected = gaussian_ball()
    row(["cells", "transmittance", "order", "scattered once", "order"])
    row(["---"] * 5)
    before: tuple[float, ...] = ()
    counts = (12, 24, 48, 96)
    for index, cells in enumerate(counts):
        errors = tuple(
            float((mine - exact).norm() / exact.norm())
            for mine, exact in zip(rendered_ball(cells), expected, strict=True)
        )
        slopes = [
            math.log(old / new) / math.log(cells / counts[index - 1])
            for old, new in zip(before, errors, strict=False)
        ] or ["", ""]
        row([cells, f"{errors[0]:.1e}", slopes[0], f"{errors[1]:.1e}", slopes[1]])
        before = errors


def ball_camera() -> Camera:
    eye, up = (
        torch.tensor([0.3, 0.4, 2.5], dtype=torch.float64),
        torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64),
    )
    return Camera(look_at(eye, torch.zeros_like(eye), up), (9, 9), 0.1)


def rendered_ball(cells: int) -> tuple[Tensor, Tensor]:
    """Transmittance along the view rays, by a background of 1 behind the absorbing ball, and
    radiance scattered once.
    """
    grid, camera = Grid((cells,) * 3, (-0.5,) * 3, (0.5,) * 3), ball_camera()
    density = PEAK * torch.exp(-sum(axis**2 for axis in grid.centers(camera.pose)) / (2 * WIDTH**2))
    absorbing, scattering = (
        torch.tensor([value], dtype=torch.float64) for value in (SIGMA_A, SIGMA_S)
    )
    g = torch.tensor(TILT, dtype=torch.float64)
    dark = Volume(grid, density, absorbing + scattering, 0 * scattering, g)
    lit = Volume(grid, density, absorbing, scattering, g)
    light = DirectionalLight(
        torch.tensor(SIDE, dtype=torch.float64), torch.tensor([1.0], dtype=torch.float64)
    )
    outside = AmbientLight(torch.tensor([1.0], dtype=torch.float64))
    scenes = (
        Scene(volume, [item], [View("view", camera)], diffusion=DiffusionSettings(model="none"))
        for volume, item in ((dark, outside), (lit, light))
    )
    one, other = (render(scene)[0, 0] for scene in scenes)
    return one, other


def gaussian_ball(steps: int = 1000) -> tuple[Tensor, Tensor]:
    """What `rendered_ball` approaches: depths of a Gaussian are error functions, and the one
    integral left is a fine sum.
    """
    bundle, distance = (
        cast_rays(ball_camera()),
        torch.linspace(1.0, 4.0, steps, dtype=torch.float64),
    )
    travel = torch.nn.functional.normalize(torch.tensor(SIDE, dtype=torch.float64), dim=0)
    origin, direction = bundle.origin.flip(-1)[:, None], bundle.direction.flip(-1)[:, None]
    point = origin + distance[:, None] * direction
    to_light = mass_before(point, travel)
    to_camera = mass_before(point, direction)
    phase = henyey_greenstein(
        -(direction * travel).sum(-1), torch.tensor(TILT, dtype=torch.float64)
    )
    density = PEAK * torch.exp(-(point**2).sum(-1) / (2 * WIDTH**2))
    emitted = (
        SIGMA_S
        * density
        * phase
        / (4 * math.pi)
        * torch.exp(-(SIGMA_A + SIGMA_S) * (to_camera + to_light))
    )
    passed = torch.exp(-(SIGMA_A + SIGMA_S) * to_camera[:, -1])
    return passed.view(9, 9), torch.trapezoid(emitted, distance).view(9, 9)


def mass_before(point: Tensor, direction: Tensor) -> Tensor:
    """The integral of the Gaussian ball's density along `direction` up to `point`."""
    along = (point * direction).sum(-1)
    across = torch.exp(-((point**2).sum(-1) - along**2) / (2 * WIDTH**2))
    return (
        PEAK
        * across
        * WIDTH
        * math.sqrt(math.pi / 2)
        * (1 + torch.erf(along / WIDTH / math.sqrt(2)))
    )


def draw(path: Path, target: Traced, renders: list[np.ndarray]) -> None:
    """Writes target, render and signed difference, a row for n = 0 and one for n = 2, where there
    is anything to see.
    """
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    top = float(target.image.max())
    seen = [np.flatnonzero(target.image.max(axis) > 0.01 * top) for axis in (1, 0)]
    crop = tuple(slice(max(0, lines[0] - 1), lines[-1] + 2) for lines in seen)
    most = max(float(np.abs(render - target.image).max()) for render in renders)
    figure, axes = plt.subplots(2, 3, figsize=(7.6, 4.9), layout="constrained")
    for line, picture, rounds in zip(axes, renders, (0, 2), strict=True):
        error = f"difference, relative RMS {target.error(picture):.3f}"
        for axis, shown, title in zip(
            line, (target.image, picture), ("path traced", f"ddrecon, n = {rounds}"), strict=False
        ):
            radiance = axis.imshow(shown[crop], cmap="gray", vmin=0, vmax=top)
            axis.set_title(title, fontsize=9)
        change = line[2].imshow(
            (picture - target.image)[crop], cmap="RdBu_r", vmin=-most, vmax=most
        )
        line[2].set_title(error, fontsize=9)
    for axis in axes.flat:
        axis.set_xticks([])
        axis.set_yticks([])
    figure.colorbar(radiance, ax=axes[:, 1], shrink=0.6, label="radiance")
    figure.colorbar(change, ax=axes[:, 2], shrink=0.6)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main() -> None:
    """Runs what the command line asks for."""
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("cases", "convergence", "order"))
    parser.add_argument("--references", type=Path, default=Path("references"))
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--only", default="")
    parser.add_argument("--degree", type=int, default=3)
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.what == "cases":
        measure_cases(given.references, given.only, given.pictures, given.degree)
    elif given.what == "convergence":
        measure_convergence(given.references)
    else:
        measure_order()


if __name__ == "__main__":
    main()
