"""Derivatives of the mean of an image against those of a path tracer, for the ball, octant by
octant.

    python benchmarks/derivatives.py [--passes 25]

The density of one octant of a soft ball (sigma_t 20, albedo 0.99) is scaled by 1 +- 0.25, and the
path tracer's two means (Mitsuba 3, extra `reference`) give a central difference with a standard
error. Ours is the derivative of ours.
"""

from __future__ import annotations

import argparse
import itertools
import math

import numpy as np
import torch

from ddrecon.cameras import Camera, look_at
from ddrecon.grid import Grid
from ddrecon.light.lights import DirectionalLight
from ddrecon.medium.coefficients import Volume
from ddrecon.renderer import render
from ddrecon.scene import Scene, View
from ddrecon.settings import DiffusionSettings, RenderSettings
from ddrecon.variables.values import with_values

CELLS, SIGMA_T, ALBEDO, FOV = 64, 20.0, 0.99, 28.0
EYE, TRAVEL = (0.0, 0.3, 3.2), (-2.0, -2.0, -1.0)
CHANGE = 0.25


def ball() -> np.ndarray:
    """Density [z, y, x]: 1 inside, falling to 0 smoothly between radii 0.27 and 0.38."""
    line = (np.arange(CELLS) + 0.5) / CELLS - 0.5
    z, y, x = np.meshgrid(line, line, line, indexing="ij")
    part = np.clip((0.38 - np.sqrt(x * x + y * y + z * z)) / 0.11, 0, 1)
    return (part * part * (3 - 2 * part)).astype(np.float32)


def gradient(density: np.ndarray) -> np.ndarray:
    """Our derivative of the mean of the image with respect to every cell."""
    eye = torch.tensor(EYE)
    camera = Camera(
        look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])),
        (32, 32),
        math.tan(math.radians(FOV) / 2),
    )
    grid = Grid((CELLS,) * 3, (-0.5,) * 3, (0.5,) * 3)
    field = torch.from_numpy(density)
    volume = Volume(
        grid,
        field,
        torch.tensor([SIGMA_T * (1 - ALBEDO)]),
        torch.tensor([SIGMA_T * ALBEDO]),
        torch.tensor(0.0),
    )
    light = DirectionalLight(torch.tensor(TRAVEL), torch.tensor([math.pi]))
    settings = RenderSettings(samples_per_pixel=4), DiffusionSettings(tolerance=1e-6)
    scene = Scene(volume, [light], [View("view", camera)], *settings)
    leaf = field.clone().requires_grad_()
    (found,) = torch.autograd.grad(render(with_values(scene, {"density": leaf})).mean(), leaf)
    return found.numpy()


def traced_means(density: np.ndarray, passes: int) -> np.ndarray:
    """The mean of the path-traced image, once for each pass."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    place = mi.ScalarTransform4f
    grid = mi.VolumeGrid(np.ascontiguousarray(density[..., None]))
    to_world = place().translate([-0.5] * 3)
    medium = {"type": "gridvolume", "grid": grid, "to_world": to_world}
    interior = {
        "type": "heterogeneous",
        "albedo": ALBEDO,
        "scale": SIGMA_T,
        "sigma_t": medium,
        "phase": {"type": "isotropic"},
    }
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    look = place().look_at(list(EYE), [0, 0, 0], [0, 1, 0])
    sampler = {"type": "independent", "sample_count": 512}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": 500, "rr_depth": 1000},
            "sensor": {
                "type": "perspective",
                "fov": FOV,
                "to_world": look,
                "film": film,
                "sampler": sampler,
            },
            "light": {
                "type": "directional",
                "direction": list(TRAVEL),
                "irradiance": {"type": "rgb", "value": math.pi},
            },
            "box": {
                "type": "cube",
                "to_world": place().scale([0.5] * 3),
                "bsdf": {"type": "null"},
                "interior": interior,
            },
        }
    )
    return np.array(
        [np.array(mi.render(scene, seed=index)).mean() for index in range(passes)], np.float64
    )


def main() -> None:
    """Prints both derivatives for every octant."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--passes", type=int, default=25)
    passes = parser.parse_args().passes
    density = ball()
    ours = gradient(density)
    side = np.arange(CELLS) >= CELLS // 2
    print("octant (x, y, z)       ours    path tracer  standard error")
    for signs in itertools.product((False, True), repeat=3):
        x, y, z = (side == sign for sign in signs)
        octant = z[:, None, None] & y[None, :, None] & x[None, None, :]
        high, low = (
            traced_means(np.where(octant, factor * density, density), passes)
            for factor in (1 + CHANGE, 1 - CHANGE)
        )
        traced = (high.mean() - low.mean()) / (2 * CHANGE)
        error = math.hypot(high.std(), low.std()) / math.sqrt(passes) / (2 * CHANGE)
        name = ", ".join("+" if sign else "-" for sign in signs)
        print(
            f"{name:>16}  {(ours * density)[octant].sum():10.3e}  {traced:10.3e}  {error:14.1e}",
            flush=True,
        )


if __name__ == "__main__":
    main()
