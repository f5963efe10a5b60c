"""How far images and derivatives are from path-traced ones: tables in Markdown.

    python benchmarks/accuracy.py eleven|derivative|angles|volumes|grounds|thick --references FOLDER

`eleven`: the cases of FOLDER/images/cases.json, whose images lie beside it. `derivative`: by all
the density of some of them, against central differences (FOLDER/fd_gradients.json).
`angles`, `volumes`, `grounds`: scenes of ours; what FOLDER/traced does not hold of them is traced
by Mitsuba 3 (extra `reference`) and kept there. An error is the relative RMS error of the image in
linear radiance, less the noise of the reference, in quadrature; `< x` is one below a third of that
noise.

`thick`: where cells are optically thick, against our own images on a grid six times as fine: the
same density, linear between the centers of the coarse grid, with angles to degree 5 and five
rounds. `default` is what a scene file gets; the others have cells as they are, or `a third` as
wide. Merged balls are lit from the side or the eye; `block` fills its box.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from figures import print_header, print_row
from torch import Tensor
from torch.nn.functional import interpolate

from ddrecon.bench import fade, plume_density
from ddrecon.grid import Grid
from ddrecon.io.volumes.table import write_field
from ddrecon.medium.coefficients import Volume
from ddrecon.picture import render
from ddrecon.reference.trace import Traced, error_text, open_tracer
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.settings import RenderSettings
from ddrecon.variables.values import with_values

Field = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Density at x, y and z, each from -0.5 to 0.5 across the box."""
Vector = tuple[float, float, float]
KnownCase = tuple[str, Path, Traced]
"""A name, a scene file that holds until the next one is written, and its path-traced image."""
CELLS, PIXELS = 48, 32
MODELS = {
    "n = 0": ("diffusion.transport_rounds=0",),
    **{f"n = {n}": (f"diffusion.transport_rounds={n}", "diffusion.degree=3") for n in (1, 2, 3)},
    "n = 2, L = 5": ("diffusion.transport_rounds=2", "diffusion.degree=5"),
    "default": (),
}
"""Overrides by column: n transport rounds of degree L, 3 unless given."""
FEWEST, MOST, PATHS, NOISE = 4, 160, 128, 0.015
"""Passes of a reference, at least and at most, paths a pixel of each, and noise that is enough."""
FRONT, FAR, SIDE, BELOW = (0.0, 0.3, 3.2), (-2.2, 0.9, -2.2), (-2.0, -1.2, -0.5), (1.2, -1.6, 2.4)


def around(center: Vector, outer: float, width: float = 0.11) -> Field:
    """A soft ball."""

    def density(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        squares = (x - center[0]) ** 2 + (y - center[1]) ** 2 + (z - center[2]) ** 2
        return fade(squares.sqrt(), outer, width)

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


def limbs(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Two thin bent limbs that cross, with soft edges."""
    one, other = (
        fade((across * across + (z + bend) ** 2).sqrt(), 0.09, 0.06) * fade(along.abs(), 0.42, 0.1)
        for across, bend, along in (
            (x - 0.2 * y, 0.1 * torch.sin(6 * y), y),
            (y - 0.3 * x, -0.1 * x, x),
        )
    )
    return 1 - (1 - one) * (1 - other)


BALL, SMALL = around((0.0, 0.0, 0.0), 0.38), around((0.22, -0.18, 0.12), 0.17, 0.06)
CLOUD = together(around((-0.13, -0.08, 0.05), 0.3), around((0.17, 0.1, -0.05), 0.25))
DEPTH_OF_BALL = 0.65
"""The integral of `BALL` across its middle, by which its optical depths are set."""


def sun(travel: Vector) -> dict[str, Any]:
    return {"type": "directional", "direction": list(travel), "irradiance": math.pi}


def from_far(degrees: float) -> Vector:
    """The way light travels that `FAR` sees so many degrees beside the middle of the box."""
    x, y, z = (part / math.hypot(*FAR) for part in FAR)
    ahead, aside = math.cos(math.radians(degrees)), math.sin(math.radians(degrees)) * math.sqrt(0.5)
    return ahead * x + aside, ahead * y, ahead * z - aside


def perspective(eye: Vector, fov: float = 28.0) -> dict[str, Any]:
    return {"type": "perspective", "origin": list(eye), "fov": fov}


@dataclass(frozen=True)
class Case:
    """A scene of ours: `field` in a box of sides `extent` around the origin."""

    name: str
    field: Field
    sigma_t: float
    albedo: float = 0.95
    g: float = 0.0
    light: tuple[dict[str, Any], ...] = (sun(SIDE),)
    camera: dict[str, Any] | None = None
    extent: Vector = (1.0, 1.0, 1.0)
    ground: tuple[float, float] | None = None
    """Its height and albedo."""

    def write(self, folder: Path, cells: int = CELLS) -> Path:
        """Its scene file of `cells`^3 cells, in `folder`."""
        centers = (torch.arange(cells) + 0.5) / cells - 0.5
        z, y, x = torch.meshgrid(centers, centers, centers, indexing="ij")
        bounds = np.array([[sign * side for side in self.extent] for sign in (-0.5, 0.5)])
        density = self.field(x, y, z).expand([cells] * 3)
        write_field(folder / "density.npz", "density", density.numpy(), bounds)
        medium = {"sigma_t": self.sigma_t, "albedo": self.albedo, "g": self.g}
        camera = {**(self.camera or perspective(FRONT)), "target": [0, 0, 0], "up": [0, 1, 0]}
        ground = dict(zip(("height", "albedo"), self.ground, strict=True)) if self.ground else None
        density = folder / "density.npz"
        return write_scene(
            folder, density, bounds, medium, list(self.light), camera, PIXELS, ground
        )


def write_scene(
    folder: Path,
    density: Path,
    bounds: np.ndarray,
    medium: dict[str, float],
    lights: list[dict[str, Any]],
    camera: dict[str, Any],
    pixels: int,
    ground: dict[str, float] | None = None,
) -> Path:
    """A scene file of one square view, 16 rays a pixel."""
    low, high = bounds.tolist()
    volume = {"bounds": {"min": low, "max": high}, "density": {"file": str(density)}, **medium}
    view = {"name": "view", "camera": {**camera, "resolution": [pixels] * 2}}
    scene = {"volume": volume, "ground": ground, "lights": lights, "views": [view]}
    path = folder / "scene.yaml"
    path.write_text(json.dumps({**scene, "render": {"samples_per_pixel": 16}}))
    return path


BALLS, CLOUDS = (partial(Case, field=field, sigma_t=25.0) for field in (BALL, CLOUD))
PLUMES = partial(Case, field=plume_density, sigma_t=25.0)
LAMP = ({"type": "point", "position": [0.9, 0.7, 0.5], "intensity": 3.0},)
AMBIENT = {"type": "ambient", "radiance": 1.0}
TALL, ABOVE = (1.0, 1.5, 1.0), perspective((1.3, 1.6, 2.6), 34.0)


def half_wide(half_width: float) -> dict[str, Any]:
    return perspective(FRONT, math.degrees(2 * math.atan(half_width)))


ANGLES = tuple(
    CLOUDS(f"{name}, g {g}", g=g, light=(sun(travel),), camera=perspective(eye))
    for name, travel, eye in (
        ("lit from the side", SIDE, FRONT),
        ("against the light", (-2.0, -0.4, -2.2), FAR),
        ("70 degrees from the light", from_far(70), FAR),
    )
    for g in (-0.9, -0.8, -0.4, 0.0, 0.6, 0.8, 0.9)
)
SLAB = {"light": (sun((-0.5, -2.0, -0.7)),), "camera": perspective((0.0, 1.6, 2.8))}
PARALLEL = {"type": "orthographic", "origin": list(BELOW), "width": 1.4}
BOTH = ({**AMBIENT, "radiance": 0.3}, sun(SIDE))
VOLUMES = (
    *(Case(f"ball, depth {depth}", BALL, depth / DEPTH_OF_BALL, 0.99) for depth in (5, 20, 60)),
    *(Case(f"ball, depth 20, albedo {a}", BALL, 20 / DEPTH_OF_BALL, a) for a in (0.5, 1.0)),
    Case("thin slab", slab, 60.0, 0.99, **SLAB),
    Case("small ball off center", SMALL, 60.0, 0.99),
    *(Case(f"thin limbs, g {g}", limbs, 40.0, g=g) for g in (-0.8, 0.85)),
    PLUMES("plume, g 0.5", g=0.5, extent=TALL, camera=half_wide(0.3)),
    BALLS("ball, point light", light=LAMP),
    CLOUDS("cloud, ambient light", light=(AMBIENT,)),
    CLOUDS("cloud, ambient light and sun", light=BOTH),
    CLOUDS("cloud in 2 x 0.5 x 1", extent=(2.0, 0.5, 1.0), camera=half_wide(0.33)),
    PLUMES("plume, parallel rays, from below", camera=PARALLEL),
)
GRAY, WHITE, FLOOR = (
    {"camera": ABOVE, "ground": g} for g in ((-0.6, 0.5), (-0.6, 0.9), (-0.75, 0.5))
)
GROUNDS = (
    CLOUDS("cloud over gray ground", albedo=0.99, **GRAY),
    CLOUDS("cloud over white ground, g 0.85", albedo=1.0, g=0.85, **WHITE),
    CLOUDS("cloud over white ground, ambient light", light=(AMBIENT,), **WHITE),
    BALLS("ball over gray ground, point light", light=LAMP, **GRAY),
    PLUMES("plume on gray ground, g 0.5", g=0.5, extent=TALL, **FLOOR),
)
CASES = {"angles": ANGLES, "volumes": VOLUMES, "grounds": GROUNDS}


def image_of(scene: Scene) -> np.ndarray:
    """The gray image [h, w] of the only view."""
    with torch.no_grad():
        return render(scene)[0].mean(0).double().numpy()


def trace(name: str, scene: Scene, folder: Path) -> Traced:
    """The path-traced image of `scene`, which `folder` keeps: passes until their mean has little
    noise.
    """
    path = folder / f"{re.sub('[^a-z0-9.-]+', '_', name)}.npz"
    if path.exists():
        return Traced.of(list(np.load(path)["images"]))
    tracer, images = open_tracer(scene, scene.views), list[np.ndarray]()
    while len(images) < FEWEST or (len(images) < MOST and Traced.of(images).noise > NOISE):
        images.append(tracer.trace(0, len(images), PATHS).mean(-1))
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(path, images=np.array(images))
    return Traced.of(images)


def known_cases(folder: Path, place: Path) -> Iterator[KnownCase]:
    """The eleven cases, their scene files in `place`."""
    for case in json.loads((folder / "images" / "cases.json").read_text()):
        full = np.load(folder / "images" / f"{case['case']}.npz")["full"]
        noise = case["noise_full"] / math.sqrt((full**2).mean())
        medium = {name: float(case[name]) for name in ("sigma_t", "albedo", "g")}
        camera = {name: case["camera"][name] for name in ("origin", "target", "up", "fov")}
        bounds = np.array([[sign * side for side in case["extent"]] for sign in (-0.5, 0.5)])
        lights = []
        for light in case["light"]:
            known = {
                key: light[key] for key in light.keys() & {"irradiance", "radiance", "direction"}
            }
            kind = "ambient" if light["type"] == "constant" else light["type"]
            lights.append(known | {"type": kind})
        density = folder / "images" / f"{case['volume']}_density.npz"
        camera["type"] = "perspective"
        path = write_scene(place, density, bounds, medium, lights, camera, case["resolution"])
        yield case["case"], path, Traced(full, noise)


def media_cases(cases: tuple[Case, ...], folder: Path, place: Path) -> Iterator[KnownCase]:
    """The same of `cases` of ours."""
    for case in cases:
        path = case.write(place)
        yield case.name, path, trace(case.name, load_scene(path), folder / "traced")


def print_errors(cases: Iterable[KnownCase]) -> None:
    """Errors of all models beside the noise of what they are compared with; mean and worst."""
    print_header("case", "noise", *MODELS)
    rows = []
    for name, path, traced in cases:
        errors = [traced.error(image_of(load_scene(path, overrides=m))) for m in MODELS.values()]
        print_row(name, traced.noise, *(error_text(error, traced.noise) for error in errors))
        rows.append(errors)
    for name, kind in (("mean", np.mean), ("worst", np.max)):
        print_row(name, "", *(f"{error:.4f}" for error in kind(rows, axis=0)))


def print_derivatives(folder: Path, place: Path) -> None:
    """Derivatives of the mean of an image by the logarithm of all density, over the true ones."""
    true = json.loads((folder / "fd_gradients.json").read_text())
    print_header("case", "its standard error", *MODELS)
    for name, path, _ in known_cases(folder, place):
        if name not in true:
            continue
        ratios = []
        for model in MODELS.values():
            scene = load_scene(path, overrides=model)
            density = scene.volume.density.clone().requires_grad_()
            mean = render(with_values(scene, {"density": density})).mean()
            (slope,) = torch.autograd.grad(mean, density)
            ratios.append(float((slope * density).sum()) / true[name][0])
        doubt = true[name][1] / true[name][0]
        print_row(name, f"{doubt:.2f}", *(f"{ratio:.2f}" for ratio in ratios))


THICK_CELLS, FINER = 12, 6
MERGED = together(around((-0.13, -0.08, 0.05), 0.32, 0.2), around((0.17, 0.1, -0.05), 0.27, 0.2))
SHOWN: dict[str, tuple[Field, Vector, Vector]] = {
    "side": (MERGED, SIDE, FRONT),
    "eye": (MERGED, (2.0, -1.2, 2.2), FAR),
    "block": (lambda x, y, z: torch.ones_like(x * y * z), (-1.0, -1.2, -1.5), (1.3, 1.1, 2.6)),
}
"""By a name, what is lit, the way light travels and the eye."""


def by_dial(rounds: int, degree: int, times: int = 1) -> tuple[str, ...]:
    keys = {"transport_rounds": rounds, "degree": degree, "refine": times}
    return tuple(f"diffusion.{key}={value}" for key, value in keys.items())


THICK_MODELS = {
    "n = 0": by_dial(0, 1),
    "n = 1, L = 1": by_dial(1, 1),
    "n = 1, L = 3": by_dial(1, 3),
    "n = 3, L = 3": by_dial(3, 3),
    "n = 1, L = 3, a third": by_dial(1, 3, 3),
    "n = 3, L = 3, a third": by_dial(3, 3, 3),
    "default": (),
}
"""Overrides by column: n transport rounds of degree L, samples of rays as by default."""


def refine(scene: Scene) -> Scene:
    """`scene` in finer cells, two samples in each."""
    volume = scene.volume
    density = interpolate(volume.density[None, None], scale_factor=FINER, mode="trilinear")[0, 0]
    grid = Grid(tuple(density.shape), volume.grid.lower, volume.grid.upper)
    finer = Volume(grid, density, volume.sigma_a, volume.sigma_s, volume.phase)
    return replace(scene, volume=finer, render=RenderSettings(4, 2, 0.0))


@torch.no_grad()
def print_thick(place: Path) -> None:
    """A row by g, optical depths a cell, and what is lit."""
    print_header("g", "depth of a cell", "lit from", *THICK_MODELS)
    for g, depth, lit in product((-0.8, 0.0, 0.6, 0.8), (1.0, 4.0, 8.0), SHOWN):
        field, travel, eye = SHOWN[lit]
        sigma_t, camera = depth * THICK_CELLS, perspective(eye, 22.0)
        path = Case(lit, field, sigma_t, 0.95, g, (sun(travel),), camera).write(place, THICK_CELLS)
        views = "views.0.camera.resolution=[16, 16]"
        truth = render(refine(load_scene(path, overrides=(views, *by_dial(5, 5)))))
        scenes = (load_scene(path, overrides=(views, *model)) for model in THICK_MODELS.values())
        errors = (float((render(scene) - truth).norm() / truth.norm()) for scene in scenes)
        print_row(str(g), f"{depth:g}", lit, *(f"{error:.3f}" for error in errors))


def main() -> None:
    """Prints what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("eleven", "derivative", "thick", *CASES))
    parser.add_argument("--references", type=Path, default=Path("references"))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        references, place = given.references, Path(name)
        if given.what == "derivative":
            print_derivatives(references, place)
        elif given.what == "thick":
            print_thick(place)
        elif given.what == "eleven":
            print_errors(known_cases(references, place))
        else:
            print_errors(media_cases(CASES[given.what], references, place))


if __name__ == "__main__":
    main()
