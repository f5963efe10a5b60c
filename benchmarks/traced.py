"""Path-traced images of scenes (Mitsuba 3, extra `reference`), kept in a folder so that a second run is quick.

Passes of independent seeds are added until the noise of their mean is low enough; light must be gray.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.cameras import Camera
from ddrecon.lights import AmbientLight, DirectionalLight, Light
from ddrecon.medium import Volume
from ddrecon.world import Scene

SAMPLES, LEAST, LONGEST = 128, 4, 1024
"""Paths a pixel in each pass, the fewest passes, and the segments of the longest path.

There is no Russian roulette: Mitsuba ends a twentieth of all paths at each scattering, whatever they carry, and what is left over of the
long paths in dense media weighs so much that noise was ten times higher.
"""


@dataclass(frozen=True)
class Traced:
    """A mean image [h, w] of several passes, and the standard error of its pixels (root mean square), relative to the image's."""

    image: np.ndarray
    noise: float

    def error(self, image: np.ndarray) -> float:
        """The relative RMS error of `image`, less this one's noise in quadrature."""
        square = ((image - self.image) ** 2).mean() / (self.image**2).mean()
        return math.sqrt(max(0.0, float(square) - self.noise**2))


def traced(scene: Scene, folder: Path, depth: int = -1, noise: float = 0.03, passes: int = 32) -> Traced:
    """The image of the only view of `scene` by paths of at most `depth` segments (2: scattered once; -1: any number).

    Passes are made until their mean has so much `noise`, but no more than so many; what `folder` holds is taken from there.
    """
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    description = mitsuba_scene(scene, depth)
    path = folder / f"{_fingerprint(scene, depth)}.npz"
    images = list(np.load(path)["images"]) if path.exists() else []
    loaded = None if _is_enough(images, noise, passes) else mi.load_dict(description)
    while not _is_enough(images, noise, passes):
        images.append(np.array(mi.render(loaded, seed=len(images), spp=SAMPLES), np.float64).mean(-1))
    if loaded is not None:
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(path, images=np.array(images))
    return Traced(np.mean(images, 0), _noise(images))


def _is_enough(images: list[np.ndarray], noise: float, passes: int) -> bool:
    return len(images) >= LEAST and (len(images) >= passes or _noise(images) <= noise)


def _noise(images: list[np.ndarray]) -> float:
    variance = np.var(images, axis=0, ddof=1) / len(images)
    return math.sqrt(variance.mean() / (np.mean(images, 0) ** 2).mean())


def _fingerprint(scene: Scene, depth: int) -> str:
    """A name for everything that the image depends on."""
    camera = scene.views[0].camera
    records: list[Any] = [scene.volume, camera, *scene.lights]
    values = [(type(record).__name__, *vars(record).values()) for record in records]
    text = repr([[_written(value) for value in record] for record in [*values, (depth, SAMPLES)]])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _written(value: object) -> object:
    return (tuple(value.shape), hashlib.sha256(value.numpy().tobytes()).hexdigest()) if isinstance(value, Tensor) else value


def mitsuba_scene(scene: Scene, depth: int) -> dict[str, Any]:
    """What Mitsuba's `load_dict` makes of `scene` and its first view."""
    lights = {f"light_{index}": _light(light) for index, light in enumerate(scene.lights)}
    integrator = {"type": "volpath", "max_depth": depth if depth > 0 else LONGEST, "rr_depth": 2 * LONGEST}
    return {"type": "scene", "integrator": integrator, "sensor": _sensor(scene.views[0].camera), "box": _box(scene.volume), **lights}


def _light(light: Light) -> dict[str, Any]:
    if isinstance(light, DirectionalLight):
        return {"type": "directional", "direction": light.direction.tolist(), "irradiance": _gray(light.irradiance)}
    if isinstance(light, AmbientLight):
        return {"type": "constant", "radiance": _gray(light.radiance)}
    return {"type": "point", "position": light.position.tolist(), "intensity": _gray(light.intensity)}


def _gray(value: Tensor) -> dict[str, Any]:
    return {"type": "rgb", "value": value.item()}


def _sensor(camera: Camera) -> dict[str, Any]:
    from mitsuba import ScalarTransform4f

    _, up, backward, origin = camera.pose.unbind(1)
    look = ScalarTransform4f().look_at(origin.tolist(), (origin - backward).tolist(), up.tolist())
    height, width = camera.size
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    sensor = {"film": film, "sampler": {"type": "independent"}}
    if camera.is_perspective:
        fov = 2 * math.degrees(math.atan(camera.half_width))
        return {"type": "perspective", "fov": fov, "fov_axis": "x", "to_world": look, **sensor}
    return {"type": "orthographic", "to_world": look.scale([camera.half_width, camera.half_width, 1]), **sensor}


def _box(volume: Volume) -> dict[str, Any]:
    from mitsuba import ScalarTransform4f, VolumeGrid

    grid, (lower, upper) = volume.grid, volume.grid.bounds_xyz
    extent, sigma_t = [high - low for low, high in zip(lower, upper, strict=True)], float(volume.sigma_a + volume.sigma_s)
    values = VolumeGrid(np.ascontiguousarray(volume.density.to(torch.float32).numpy()[..., None]))
    density = {"type": "gridvolume", "grid": values, "raw": True, "to_world": ScalarTransform4f().translate(list(lower)).scale(extent)}
    medium = {
        "type": "heterogeneous",
        "sigma_t": density,
        "scale": sigma_t,
        "albedo": float(volume.sigma_s) / sigma_t,
        "phase": {"type": "hg", "g": float(volume.g)},
    }
    place = ScalarTransform4f().translate(list(grid.center_xyz)).scale([0.5 * side for side in extent])
    return {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": medium}
