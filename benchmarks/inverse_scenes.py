"""Scenes whose volume is known, for `inverse.py`: clouds, a solid and a glowing ball.

A `Case` is written as a scene that seeks its volume, beside the volume in the cells of that scene.
Pictures are those of narrower cells, more rounds, angles and rays, with noise. Lengths of clouds
are in km, z up; fields are [z, y, x]. All is computed from fixed seeds.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from figures import ddrecon
from numpy.typing import NDArray

Array = NDArray[np.float64]
View = dict[str, Any]
EXACT = {
    "diffusion": {"transport_rounds": 6, "degree": 5},
    "render": {"samples_per_pixel": 9, "background": False},
}
NOISE, LEAST_NOISE = 0.01, 0.002
"""Standard deviations: of a pixel's value, and of the brightest pixel's."""
ANGLES = (70.5, 60.0, 45.6, 26.1, 0.0, -26.1, -45.6, -60.0, -70.5)
"""From the zenith, along a track: those of MISR [degrees]."""
DEPTHS = (5, 10, 17, 40, 80)
"""The largest optical depths of columns of AT3D's clouds."""


@dataclass(frozen=True)
class Case:
    """A volume, and the views by which it is sought.

    `fields` [z, y, x] are in cells of which `times` fit into one of the scene along each axis.
    `volume` says everything else of it.
    """

    fields: dict[str, Array]
    times: int
    volume: dict[str, Any]
    lights: list[dict[str, Any]]
    views: list[View]

    def write(self, folder: Path) -> None:
        """Writes `scene.yaml`, its pictures, and `truth.npz` into `folder`."""
        folder.mkdir(parents=True, exist_ok=True)
        bounds = np.array([self.volume["bounds"][corner] for corner in ("min", "max")])
        fine = {name: field.astype(np.float32) for name, field in self.fields.items()}
        np.savez(folder / "fine.npz", bounds=bounds, **fine)
        cells = [count // self.times for count in self.fields["density"].shape]
        coarse = {name: coarsened(field, tuple(cells)) for name, field in self.fields.items()}
        np.savez(folder / "truth.npz", bounds=bounds, **coarse)
        known = {name: {"file": "fine.npz"} for name in self.fields}
        scene = {"volume": self.volume | known, "lights": self.lights, "views": self.views}
        (folder / "fine.yaml").write_text(json.dumps(scene | EXACT))  # JSON is YAML
        # In a process of its own: what this one takes would count as memory of its runs.
        ddrecon("render", "fine.yaml", "-o", "images", folder=folder)
        chance = np.random.default_rng(1)
        for view in self.views:
            picture = np.load(folder / "images" / f"{view['name']}.npy")
            noise = np.hypot(NOISE * picture, LEAST_NOISE * picture.max())
            # Gray pictures have one noise in all colors.
            picture = picture + noise * chance.normal(size=(*picture.shape[:2], 1))
            np.save(folder / f"{view['name']}.npy", picture.astype(np.float32))
        views = [view | {"image": f"{view['name']}.npy"} for view in self.views]
        volume = self.volume | {"resolution": cells[::-1], "density": 0}
        sought = {name: {"init": 0, "min": 0} for name in self.fields}
        scene |= {"volume": volume, "views": views, "render": {"background": False}}
        scene["optimize"] = {"iterations": "auto", "parameters": sought}
        (folder / "scene.yaml").write_text(json.dumps(scene, indent=1))


def coarsened(density: Array, shape: Sequence[int]) -> Array:
    """Means of `density` over the cells of a grid of `shape`."""
    for axis, (count, cells) in enumerate(zip(shape, density.shape, strict=True)):
        parts = np.repeat(density, math.lcm(count, cells) // cells, axis)
        parts = parts.reshape(*parts.shape[:axis], count, -1, *parts.shape[axis + 1 :])
        density = parts.mean(axis + 1)
    return density


def box(low: Sequence[float], high: Sequence[float]) -> dict[str, Any]:
    return {"bounds": {"min": list(low), "max": list(high)}}


def centers(bounds: dict[str, Any], cells: Sequence[int]) -> Array:
    """Centers [z, y, x, 3] of the `cells` along x, y, z of a volume's `bounds`, as (x, y, z)."""
    ends = bounds["bounds"]["min"], bounds["bounds"]["max"], cells
    lines = [a + (np.arange(n) + 0.5) / n * (b - a) for a, b, n in zip(*ends, strict=True)]
    return np.stack(np.meshgrid(*lines, indexing="ij"), -1).transpose(2, 1, 0, 3)


def turbulence(points: Array, seed: int) -> Array:
    """A periodic random field of variance 1 at `points`: its spectrum is Kolmogorov's, k^(-11/3)
    in three dimensions.
    """
    shape, corner = points.shape[:3], points[0, 0, 0]
    steps = (points[1, 1, 1] - corner)[::-1]
    waves = [np.fft.fftfreq(n, step) for n, step in zip(shape, steps, strict=True)]
    square = np.square(np.meshgrid(*waves, indexing="ij")).sum(0)
    square[0, 0, 0] = np.inf
    white = np.random.default_rng(seed).normal(size=shape)
    field: Array = np.fft.ifftn(np.fft.fftn(white) * square ** (-11 / 12)).real
    return field / field.std()


def droplets(points: Array, reach: Array, base: float, depth: float, seed: int) -> Array:
    """Extinction of clouds, at most about 1: where `reach`, 1 in their middle and 0 at their edge,
    is positive with turbulence added, above the flat `base`.

    Liquid water grows with height over a `depth`, as in air that rises without mixing, and
    extinction as its power 2/3.
    """
    rise = (points[..., 2] - base) / depth
    inside = np.clip(5 * (reach + 0.3 * turbulence(points, seed)), 0, 1) * (rise > 0)
    return inside * np.clip(rise, 0.1, 1) ** (2 / 3)


def dome(points: Array, x: float, y: float, base: float, radius: float, height: float) -> Array:
    """1 in the middle of a cloud's base and 0 at its edge, half an ellipsoid."""
    distance = (points - (x, y, base)) / (radius, radius, height)
    return 1 - (distance**2).sum(-1)


def look(name: str, middle: Sequence[float], away: Sequence[float], **camera: Any) -> View:
    """A view of `middle` from the point `away` from it, in perspective unless it says else."""
    camera = {"type": "perspective"} | camera | {"target": list(middle)}
    camera["origin"] = np.add(middle, away).tolist()
    return {"name": name, "split": name.split("_")[0], "camera": camera}


def along_track(middle: Sequence[float], width: float, pixels: int) -> list[View]:
    """Nine views along y, and a tenth across them that is held out, by parallel rays."""
    camera = {"type": "orthographic", "up": [0, 1, 0], "width": width, "resolution": [pixels] * 2}
    ways = [(f"train_{number}", 0.0, angle) for number, angle in enumerate(ANGLES)]
    views = []
    for name, x, y in [*ways, ("test_across", 50.0, 20.0)]:
        way = np.array([math.tan(math.radians(x)), math.tan(math.radians(y)), 1])
        views.append(look(name, middle, 5 * way / np.linalg.norm(way), **camera))
    return views


def sun(*direction: float) -> list[dict[str, Any]]:
    return [{"type": "directional", "direction": list(direction), "irradiance": math.pi}]


def cloud_optics(sigma_t: float) -> dict[str, Any]:
    return {"up": "z", "sigma_t": sigma_t, "albedo": 1, "g": 0.85}


def cumuli() -> Case:
    """Three cumuli on 32 x 37 x 26 cells, by five cameras from above; two are held out.

    Below them the box is empty, where no view sees it.
    """
    bounds, times = box([0, 0, 0], [0.64, 0.74, 1.04]), 3
    points = centers(bounds, [n * times for n in (32, 37, 26)])
    places = [(0.24, 0.27, 0.18, 0.46), (0.42, 0.48, 0.15, 0.4), (0.2, 0.56, 0.1, 0.2)]
    reach = np.max([dome(points, x, y, 0.4, *size) for x, y, *size in places], 0)
    middle = [0.32, 0.37, 0.52]
    above = [(-0.5, 0, 1.35), (-0.25, 0.1, 1.4), (0, -0.1, 1.45), (0.25, 0.1, 1.4), (0.5, 0, 1.35)]
    eyes = [(f"train_{number}", eye, [0, 1, 0]) for number, eye in enumerate(above)]
    eyes += [("test_0", (0.1, 0.5, 1.3), [0, 1, 0]), ("test_1", (1.5, 0.4, 0.6), [0, 0, 1])]
    camera = {"fov": 36, "resolution": [40] * 2}
    views = [look(name, middle, eye, up=up, **camera) for name, eye, up in eyes]
    density = droplets(points, reach, 0.4, 0.4, seed=3)
    return Case({"density": density}, times, bounds | cloud_optics(120), sun(0.15, 0.1, -1), views)


def stratocumulus() -> Case:
    """A patch of a layer on 32 x 32 x 12 cells, of optical depth 8 where it is."""
    bounds, times = box([0, 0, 0.5], [1.6, 1.6, 0.86]), 3
    points = centers(bounds, [n * times for n in (32, 32, 12)])
    waves = turbulence(points, 5).mean(0, keepdims=True)
    top = 0.7 + 0.04 * waves / waves.std()
    inland = 0.7 - np.linalg.norm(points[..., :2] - 0.8, axis=-1)
    reach = np.clip(np.minimum((top - points[..., 2]) / 0.06, inland / 0.1), -2, 0.7)
    density = droplets(points, reach, 0.56, 0.2, seed=6)
    columns = density.sum(0) * 0.36 / len(density)
    medium = bounds | cloud_optics(round(float(8 / columns[columns > 0].mean()), 1))
    views = along_track([0.8, 0.8, 0.68], 1.7, 40)
    return Case({"density": density}, times, medium, sun(0.4, 0.3, -0.87), views)


def at3d(depth: int) -> Case:
    """A stochastic cumulus in 1 km^3, cells of 40 m, nine views of 35 m a pixel: AT3D's protocol
    (doi:10.5194/amt-16-3931-2023). Its densest column has the optical `depth`.
    """
    bounds, times = box([0, 0, 0], [1, 1, 1]), 3
    points = centers(bounds, [25 * times] * 3)
    density = droplets(points, dome(points, 0.5, 0.5, 0.2, 0.36, 0.6), 0.2, 0.5, seed=11)
    sigma_t = depth / (density.sum(0).max() / len(density))
    views = along_track([0.5, 0.5, 0.5], 1.4, 40)
    medium = bounds | cloud_optics(round(float(sigma_t), 3))
    return Case({"density": density}, times, medium, sun(0.35, 0.35, -0.87), views)


def ring(count: int, distance: float, **camera: Any) -> list[View]:
    """Views around the origin, and two that are held out, from above and below."""
    eyes = []
    for number, angle in enumerate(2 * math.pi * np.arange(count) / count):
        around = distance * math.sin(angle), 0.1 * distance, distance * math.cos(angle)
        eyes.append((f"train_{number}", around))
    eyes += [("test_0", (2.0, 1.6, 2.0)), ("test_1", (-2.4, -0.8, 2.0))]
    camera |= {"up": [0, 1, 0], "fov": 28}
    return [look(name, (0, 0, 0), eye, **camera) for name, eye in eyes]


def solid() -> Case:
    """A sitting animal of ellipsoids with sharp edges, on 64 x 96 x 64 cells, by ten views."""
    bounds, times = box([-0.5, -0.75, -0.5], [0.5, 0.75, 0.5]), 2
    points = centers(bounds, [n * times for n in (64, 96, 64)])
    blobs = [  # x, y, z, radii, and how far each leans along x
        ((0.03, -0.34, 0), (0.31, 0.27, 0.25), 0.0),
        ((-0.2, 0.06, 0), (0.17, 0.16, 0.14), 0.0),
        *(((-0.08, 0.38, z), (0.05, 0.24, 0.045), 0.25) for z in (0.09, -0.09)),
        ((0.35, -0.42, 0), (0.09, 0.09, 0.09), 0.0),
        *(((-0.22, -0.56, z), (0.13, 0.06, 0.07), 0.0) for z in (0.16, -0.16)),
    ]
    density = np.zeros(points.shape[:3])
    for middle, radii, lean in blobs:
        away = points - middle
        away[..., 0] -= lean * away[..., 1]
        density[np.linalg.norm(away / radii, axis=-1) < 1] = 1
    views = ring(10, 3.2, resolution=[128] * 2)
    medium = bounds | {"sigma_t": 20, "albedo": 0.95, "g": 0.3}
    return Case({"density": density}, times, medium, sun(-2, -2, -1), views)


def glowing_ball(sigma_t: float) -> Case:
    """A ball of 32^3 cells that glows in the sun: its emission is sought beside its density."""
    bounds, times = box([-0.5] * 3, [0.5] * 3), 3
    points = centers(bounds, [32 * times] * 3)
    radius = np.linalg.norm(points, axis=-1)
    density = 1 / (1 + np.exp((radius - 0.33) / 0.01))
    spot = np.linalg.norm(points - (0.12, 0.1, -0.08), axis=-1)
    glow = 0.85 * np.exp(-((radius / 0.24) ** 2)) + 1.2 * np.exp(-((spot / 0.1) ** 2))
    views = ring(8, 2.8, resolution=[48] * 2)
    medium = bounds | {"sigma_t": sigma_t, "albedo": 0.7, "g": 0.4}
    fields = {"density": density, "emission": density * glow}
    return Case(fields, times, medium, sun(-0.5, -0.8, -0.33), views)


BUILDERS: dict[str, Callable[[], Case]] = {
    "cumuli": cumuli,
    "solid": solid,
    "stratocumulus": stratocumulus,
    **{f"ball_glows_{depth}": partial(glowing_ball, depth) for depth in (4, 10, 15)},
    **{f"at3d_{depth}": partial(at3d, depth) for depth in DEPTHS},
}
