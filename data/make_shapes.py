"""Makes data/shapes: the bunny, a torus knot, a cloud and a colored smoke, the volumes of the
paper's experiments.

    npm pack bunny@1.0.1 && python data/make_shapes.py bunny-1.0.1.tgz

`--times 3` makes them in cells three times as small, `-o` elsewhere. The bunny's mesh is that of
the npm package `bunny`, which its author gave to the public domain; all else is computed here, from
fixed seeds.
"""

from __future__ import annotations

import argparse
import json
import re
import tarfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FOLDER = Path(__file__).parent / "shapes"
TALL = np.array([[-0.5, -0.75, -0.5], [0.5, 0.75, 0.5]])
CUBE = np.array([[-0.5] * 3, [0.5] * 3])
SAMPLES = 3
"""Samples of the bunny along each side of a cell."""
LEVELS = 64
"""Fields are rounded to so many steps per unit: what cannot be seen need not be shipped."""


def centers(bounds: Array, cells: tuple[int, int, int]) -> Array:
    """Centers [z, y, x, 3] of the `cells` (x, y, z) of the box `bounds`, as (x, y, z) [u]."""
    lines = [
        low + (np.arange(count) + 0.5) / count * (high - low)
        for low, high, count in zip(*bounds, cells, strict=True)
    ]
    return np.stack(np.meshgrid(*lines, indexing="ij"), -1).transpose(2, 1, 0, 3)


def bunny_mesh(package: Path) -> Array:
    """Triangles [n, 3, 3] of the bunny: corners (x, y, z) [u], centered, 0.88 u wide."""
    with tarfile.open(package) as archive:
        source = archive.extractfile("package/index.js").read().decode()
    positions, cells = (
        np.array(json.loads(re.search(rf"exports\.{name}=(\[\[.*?\]\])", source)[1]))
        for name in ("positions", "cells")
    )
    low, high = positions.min(0), positions.max(0)
    triangles: Array = (positions - (low + high) / 2)[cells] * (0.88 / (high - low)[0])
    return triangles


def is_inside(triangles: Array, points: Array) -> NDArray[np.bool_]:
    """Whether each of the lattice `points` [z, y, x, 3] is within the closed surface of
    `triangles`.

    Along each line of points in x the surface is crossed once in and once out: those crossings
    behind a point, counted with the sign of the triangle's side, add up to its winding number, 1
    within and 0 without.
    """
    y, z, x = points[0, :, 0, 1], points[:, 0, 0, 2], points[0, 0, :, 0]
    crossings = np.zeros((len(z), len(y), len(x) + 1), np.int32)
    for corner, first, second in zip(*np.moveaxis(triangles, 1, 0), strict=True):
        edges = first - corner, second - corner
        area = edges[0][1] * edges[1][2] - edges[0][2] * edges[1][1]
        if area == 0:
            continue
        rows, columns = (
            _between(line, [corner[axis], first[axis], second[axis]])
            for line, axis in ((z, 2), (y, 1))
        )
        v, u = np.meshgrid(z[rows] - corner[2], y[columns] - corner[1], indexing="ij")
        a, b = (
            (u * edges[1][2] - v * edges[1][1]) / area,
            (v * edges[0][1] - u * edges[0][2]) / area,
        )
        k, j = np.nonzero((a >= 0) & (b >= 0) & (a + b < 1))
        depth = corner[0] + a[k, j] * edges[0][0] + b[k, j] * edges[1][0]
        np.add.at(
            crossings,
            (rows.start + k, columns.start + j, np.searchsorted(x, depth)),
            -int(np.sign(area)),
        )
    return np.abs(crossings.cumsum(2)[..., :-1]) % 2 == 1


def _between(line: Array, values: list[float]) -> slice:
    """The part of the rising `line` between the least and the greatest of `values`."""
    return slice(int(np.searchsorted(line, min(values))), int(np.searchsorted(line, max(values))))


def bunny(package: Path, cells: tuple[int, int, int]) -> Array:
    """Density [z, y, x]: the part of each cell that is within the bunny."""
    x, y, z = cells
    fine = is_inside(bunny_mesh(package), centers(TALL, (x * SAMPLES, y * SAMPLES, z * SAMPLES)))
    part: Array = fine.reshape(z, SAMPLES, y, SAMPLES, x, SAMPLES).mean((1, 3, 5))
    return part


def knot(points: Array) -> Array:
    """Density at `points`: a trefoil of tube radius 0.09 u, its surface smoothed over 0.03 u."""
    turn = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    ring = 2 + np.cos(3 * turn)
    curve = np.stack(
        [0.12 * ring * np.cos(2 * turn), 0.19 * ring * np.sin(2 * turn), 0.2 * np.sin(3 * turn)], -1
    )
    square = np.full(points.shape[:-1], np.inf)
    for place in curve:
        square = np.minimum(square, ((points - place) ** 2).sum(-1))
    return 1 / (1 + np.exp((np.sqrt(square) - 0.09) / 0.008))


def swirl(points: Array, seed: int, strength: float) -> Array:
    """Where the `points` [..., 3] came from, carried backward by a curl noise for the time
    `strength`.

    The velocity is the curl of a sum of waves, without divergence: it folds a shape and neither
    thins nor thickens it.
    """
    chance = np.random.default_rng(seed)
    waves = chance.normal(size=(24, 3)) * np.geomspace(6, 30, 24)[:, None]
    swing = np.cross(waves, chance.normal(size=(24, 3))) / (waves**2).sum(-1, keepdims=True) ** 0.9
    phase = chance.uniform(0, 2 * np.pi, 24)
    for _ in range(12):
        points = points - strength / 12 * np.cos(points @ waves.T + phase) @ swing
    return points


def smooth_step(distance: Array, width: float) -> Array:
    """1 where `distance` is well below 0, 0 where it is well above, changing over `width`."""
    return 1 / (1 + np.exp(np.clip(distance / width, -50, 50)))


def cloud(points: Array) -> Array:
    """Density at `points` of the cube: three merged balls, folded by curl noise."""
    places = swirl(points, 3, 0.12)
    balls = [((-0.13, -0.08, 0.0), 0.23), ((0.15, -0.05, 0.05), 0.21), ((0.0, 0.13, -0.03), 0.2)]
    distance = np.min(
        [np.linalg.norm(places - center, axis=-1) - radius for center, radius in balls], 0
    )
    return smooth_step(distance, 0.02)


def black_optics(points: Array) -> tuple[Array, Array]:
    """sigma_a and sigma_s [..., 3] [1/u] of the black cloud at `points`, of the order of 7 and 4,
    changing over half the box.
    """
    x, y, z = np.moveaxis(points, -1, 0)
    waves = np.stack([np.sin(6 * x + 1), np.sin(6 * y), np.cos(5 * z + 3 * x)], -1)
    return 7 + 3 * waves, 4 + 1.5 * np.roll(waves, 1, -1)


def smoke(points: Array) -> tuple[Array, Array]:
    """Density and albedo [..., 3] at `points` of the cube: a column of red, green and blue smoke,
    folded by curl noise.
    """
    places = swirl(points, 11, 0.15)
    x, y, z = np.moveaxis(places, -1, 0)
    density = smooth_step(np.hypot(x, z) - 0.13 - 0.12 * y, 0.02) * smooth_step(
        np.abs(y) - 0.33, 0.02
    )
    angle = np.arctan2(z, x) + 5 * y
    hue = np.stack([np.cos(angle - shift) for shift in (0, 2 * np.pi / 3, 4 * np.pi / 3)], -1)
    return density, 0.72 + 0.25 * hue


def write(path: Path, bounds: Array, **fields: Array) -> None:
    """Writes `fields`, rounded, as float16 beside `bounds`."""
    rounded = {
        name: (np.round(values * LEVELS) / LEVELS).astype(np.float16)
        for name, values in fields.items()
    }
    np.savez_compressed(path, bounds=bounds, **rounded)


def main() -> None:
    """Writes the volumes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("package", type=Path, help="bunny-1.0.1.tgz")
    parser.add_argument("--times", type=int, default=1, help="cells so many times as small")
    parser.add_argument("-o", "--output", type=Path, default=FOLDER)
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    tall = 64 * given.times, 96 * given.times, 64 * given.times
    cube = centers(CUBE, (48 * given.times,) * 3)
    write(given.output / "bunny.npz", TALL, density=bunny(given.package, tall))
    write(given.output / "knot.npz", TALL, density=knot(centers(TALL, tall)))
    sigma_a, sigma_s = black_optics(cube)
    write(given.output / "cloud.npz", CUBE, density=cloud(cube), sigma_a=sigma_a, sigma_s=sigma_s)
    density, albedo = smoke(cube)
    write(
        given.output / "smoke.npz",
        CUBE,
        density=density,
        sigma_a=20 * (1 - albedo),
        sigma_s=20 * albedo,
    )


if __name__ == "__main__":
    main()
