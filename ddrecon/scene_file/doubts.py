"""What is legal in a scene but can hardly be meant: optical depths and distances.

Most come of lengths in different units: bounds in millimeters, cameras in meters.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from ddrecon.light.ground import stay_above
from ddrecon.light.lights import EnvironmentLight
from ddrecon.medium.coefficients import Volume, scale_medium
from ddrecon.scene import Scene
from ddrecon.settings import DiffusionSettings
from ddrecon.variables.values import extinction_of, with_values

THICKEST, THINNEST = 3e3, 1e-3
"""Optical depths beyond these look like a wall, or like nothing."""
THICK_FACES, ABSORBING = 2.0, 2.5
"""A cell at a face of extinction k, the forward peak left out, and absorption a is too thick where
k + 2.5 sqrt(a k), times its size, is beyond 2: images are off by a fifth (docs/hard_cases.md)."""
FORWARD = 0.5
"""From this mean cosine on g may be traded for fewer scatterings."""
SMALLEST = 2.0
"""A box of fewer pixels than this, along its diagonal, shows nothing."""
UPRIGHT = 0.7
"""A camera whose right is so much along the way up lies on its side."""
UNITS = "are volume.bounds, cross sections and cameras in the same unit?"


def find_doubts(scene: Scene) -> list[str]:
    """A line about each number of `scene` that can hardly be meant; parameters are at their start.

    Where the density starts as nothing, optical depths are those of a density of 1.
    """
    volume = with_values(scene, scene.starts).volume
    extinction = extinction_of(volume).amax(0)
    return [
        *_doubt_depth(volume, extinction),
        *_doubt_faces(volume, extinction, scene.diffusion),
        *_doubt_cameras(scene),
        *_doubt_ground(scene),
    ]


def _doubt_depth(volume: Volume, extinction: Tensor) -> Iterator[str]:
    density, where = volume.density, "through the densest part"
    if not bool(density.any()):
        density, where = torch.ones_like(density), "at a density of 1"
    # The thickest line of cells along each axis.
    lines = [float((extinction * density).sum(axis).max()) for axis in range(3)]
    depths = [line * size for line, size in zip(lines, volume.grid.spacing, strict=True)]
    if min(depths) > THICKEST or max(depths) < THINNEST:
        yield f"volume: the optical depth across the box is {max(depths):.3g} {where}; {UNITS}"


def _doubt_faces(volume: Volume, extinction: Tensor, settings: DiffusionSettings) -> Iterator[str]:
    """Whether a medium that scatters is thick in cells at the faces of the box.

    What counts is the depth without the forward peak, and more of it where light is absorbed.
    """
    if not bool((volume.sigma_s > 0).any()):
        return
    medium = scale_medium(volume, settings.angles)
    finer = volume.grid.refine(settings.times, settings.refine_along)
    lost = medium.extinction.value
    lost = lost + ABSORBING * (medium.absorption.value * lost).sqrt()
    thickest, depth = (
        max(
            float(field.select(axis - 3, end).max()) * size
            for axis, size in enumerate(finer.spacing)
            for end in (0, -1)
        )
        for field in (lost, extinction * volume.density)
    )
    if thickest > THICK_FACES:
        times, g = thickest / THICK_FACES, float(medium.g.max())
        advice = f"take cells {times:.1f} times smaller, and leave a layer of empty ones"
        if g >= FORWARD:
            advice = f"say g: 0 and sigma_s times {1 - g:.2g} (similarity), or {advice}"
        cells = f"cells at the faces of the box are up to {depth:.3g} optical depths thick"
        yield f"volume: {cells}; images may be off by a fifth and more: {advice}"


def _doubt_cameras(scene: Scene) -> Iterator[str]:
    small, inside = list[str](), list[str]()
    for view in scene.views:
        camera, place = view.camera, view.camera.pose[:, 3].double()
        low, high = (place.new_tensor(corner) for corner in scene.volume.grid.bounds_xyz)
        distance = float(torch.dist((low + high) / 2, place)) if camera.is_perspective else 1.0
        # The diagonal of the box, seen from the side, takes hardly any pixels.
        width = 2 * float(camera.half_width) * distance
        if float(torch.dist(low, high)) * camera.size[1] < SMALLEST * width:
            small.append(view.name)
        if camera.is_perspective and bool(((low < place) & (place < high)).all()):
            inside.append(view.name)
    faults = ("the box is smaller than a pixel or two to", small), ("inside the box:", inside)
    for fault, names in faults:
        if names:
            more = f" and {len(names) - 1} more" if len(names) > 1 else ""
            yield f"views: {fault} camera {names[0]}{more}; {UNITS}"


def _doubt_ground(scene: Scene) -> Iterator[str]:
    """Lights that a ground hides, and cameras that lie on their side."""
    if scene.ground is None:
        return
    plane, up = scene.ground.plane, 2 - scene.ground.plane.axis
    tilted = [v.name for v in scene.views if abs(float(v.camera.pose[up, 0])) > UPRIGHT]
    if tilted:
        yield f"ground: volume.up is {'xyz'[up]}, and camera {tilted[0]} lies on its side"
    for index, light in enumerate(scene.lights):
        if not isinstance(light, EnvironmentLight) and not stay_above([light], plane):
            below = f"below the ground at {plane.height:g}"
            yield f"lights.{index}: shines from {below}, and is not seen"
