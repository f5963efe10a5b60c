"""What a scene is as tensors: a volume, its lights and its views, and the settings of both.

The physics and the reconstruction read these records; `ddrecon.scene_file` has how they are written
in a file.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from ddrecon.cameras import Camera
from ddrecon.defaults import choose_diffusion, choose_exchanges, find_occupied
from ddrecon.errors import UsageError
from ddrecon.grid import Triple
from ddrecon.light.ground import Ground
from ddrecon.light.lights import Light
from ddrecon.march.samplers import choose_steps
from ddrecon.medium.coefficients import Volume
from ddrecon.pictures.noise import Noise
from ddrecon.records import bounded, faults_of
from ddrecon.settings import DiffusionSettings, OptimizeSettings, RenderSettings


@dataclass(eq=False)
class View:
    """One view: its camera, and its target `image` [3, h, w] (linear radiance) where it has one.

    `mask` [h, w] is 1 where a pixel counts and 0 where it is ignored; None counts all. Test views
    are never optimized on; `weight` > 0 is how much a training view counts.

    What its camera does to radiance (E9.1): `exposure` > 0 and `offset`, [1] or [3], None for 1 and
    0; `background` [C, h, w] or [C, 1, 1] is what the picture shows where the volume is empty, None
    for the light behind it. `step` and `noise` say how the picture errs, see `ddrecon.pictures`.
    """

    name: str
    camera: Camera
    image: Tensor | None = None
    mask: Tensor | None = None
    is_test: bool = False
    weight: float = bounded(1.0, above=0)
    exposure: Tensor | None = None
    offset: Tensor | None = None
    background: Tensor | None = None
    step: float = bounded(0.0, minimum=0)
    noise: Noise | None = None

    @property
    def seen(self) -> Tensor:
        """Its image, black where pixels do not count."""
        assert self.image is not None
        return self.image if self.mask is None else self.image * self.mask


@dataclass(eq=False, repr=False)
class Scene:
    """A scene, of a file or made in Python.

    `optimize` is what its file, `path`, says of reconstruction; `starts` holds the value that each
    optimized parameter starts from; `ground` lies under the volume, where there is any. What
    `render` and `diffusion` leave out is chosen by the medium when the scene is made, and stays
    when the medium changes. So do `occupied` and `exchanges`, where there is a ground: where the
    part of the box begins and ends, along z, y and x from 0 to 1, that has any medium; and how
    often light goes to and fro between that and the ground. `reason`: which settings of
    `diffusion` these are, and why. `up`: which of x, y, z (0, 1, 2) points up; None where cameras
    tell.
    """

    volume: Volume
    lights: list[Light]
    views: list[View]
    render: RenderSettings = field(default_factory=RenderSettings)
    diffusion: DiffusionSettings = field(default_factory=DiffusionSettings)
    optimize: OptimizeSettings | None = None
    starts: dict[str, Tensor] = field(default_factory=dict)
    path: Path | None = None
    ground: Ground | None = None
    reason: str = ""
    up: int | None = None
    occupied: tuple[Triple, Triple] | None = None
    exchanges: int | None = None

    def __post_init__(self) -> None:
        self.settle()

    def settle(self) -> None:
        """Has what settings leave out become what the medium deserves, in files and in Python."""
        if any(faults_of(self, keys=("volume", "render", "diffusion"))):
            return  # it cannot be rendered, which `render` says
        volume, optimized = self.volume, self.optimize.parameters if self.optimize else ()
        media = [*volume.media.values()] if volume.media else [volume]
        with torch.no_grad():
            if self.ground is not None and self.occupied is None:
                self.occupied = find_occupied(volume, media, self.ground, optimized)
                is_periodic = bool(volume.grid.periodic)
                self.exchanges = choose_exchanges(self.ground, is_periodic, optimized)
            self.diffusion, reason = choose_diffusion(self.diffusion, volume, media, optimized)
            if self.render.steps_per_voxel is None:
                steps = choose_steps(volume, self.diffusion.times)
                self.render = replace(self.render, steps_per_voxel=steps)
        self.reason = reason or self.reason

    def view(self, name: str) -> View:
        """The view called `name`; raises UsageError with the known names."""
        for view in self.views:
            if view.name == name:
                return view
        names = ", ".join(view.name for view in self.views)
        raise UsageError(f"no view {name!r}; the views are {names}")
