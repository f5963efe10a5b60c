"""What a scene is as tensors: a volume, its lights and its views, and the settings of both.

The physics and the reconstruction read these records; `ddrecon.scene_file` has how they are written
in a file.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor

from ddrecon.cameras import Camera
from ddrecon.display import Displayed
from ddrecon.errors import UsageError
from ddrecon.light.ground import Ground
from ddrecon.light.lights import Light
from ddrecon.medium.coefficients import Volume
from ddrecon.pictures.noise import Noise
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
    weight: float = 1.0
    exposure: Tensor | None = None
    offset: Tensor | None = None
    background: Tensor | None = None
    step: float = 0.0
    noise: Noise | None = None


@dataclass(eq=False, repr=False)
class Scene(Displayed):
    """A loaded scene.

    `optimize` is what its file, `path`, says of reconstruction; `starts` holds the value that each
    optimized parameter starts from; `ground` lies under the volume, where there is any. `reason`:
    which settings of `diffusion` its file leaves out, and what of the medium decides them. `up`:
    which of x, y, z (0, 1, 2) points up; None where cameras tell.
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

    def view(self, name: str) -> View:
        """The view called `name`; raises UsageError with the known names."""
        for view in self.views:
            if view.name == name:
                return view
        names = ", ".join(view.name for view in self.views)
        raise UsageError(f"no view {name!r}; the views are {names}")
