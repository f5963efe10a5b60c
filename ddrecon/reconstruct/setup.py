"""What a run begins with: its views and parameters, if they are usable; coarse to fine."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch.nn.functional import adaptive_avg_pool2d

from ddrecon.cameras import CELL, cell_width
from ddrecon.errors import FormatError, SceneError, UsageError
from ddrecon.grid import Grid
from ddrecon.light.lights import BRIGHTNESS
from ddrecon.losses import Target
from ddrecon.medium.coefficients import resample, volume_at_level
from ddrecon.pictures import Noise, estimate_noise
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.objective import describe_flaw, target_of
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.support import Support, find_support
from ddrecon.scene import Scene, View
from ddrecon.settings import AUTO, Iterations, OptimizeSettings
from ddrecon.variables.kinds import kind_of, unit_of
from ddrecon.variables.values import value_of, variable_names, with_values


@dataclass(frozen=True)
class Problem:
    """What a run is to find, and from what; nothing of it changes.

    The objective is the weighted mean of the image loss of `train`'s views plus, for each
    parameter, its penalty times `unit`, the mean square of the targets as the `loss` compares them,
    or 1 if all are black. `test` has the views that are held out, `factors` how much coarser each
    level is.
    """

    scene: Scene
    settings: OptimizeSettings
    train: Scene
    test: Scene
    loss: str
    noises: Mapping[str, Noise]
    unit: float
    support: Support | None
    factors: Sequence[int]

    @staticmethod
    def of(scene: Scene, iterations: Iterations | None = None) -> Problem:
        """What `scene` asks for, in as many `iterations` as it says, or as given.

        Raises SceneError and FormatError where that cannot be had, UsageError for `iterations`
        that are none.
        """
        if isinstance(iterations, str) and iterations != AUTO:
            raise UsageError(f"iterations: expected a number or {AUTO!r}, found {iterations!r}")
        if (settings := scene.optimize) is None:
            raise SceneError(
                "optimize: missing section; say what to reconstruct, such as"
                " parameters: {density: {}}"
            )
        if iterations is not None:
            settings = replace(settings, iterations=iterations)
        train, test = (select_views(scene, is_test) for is_test in (False, True))
        require_usable(train, settings)
        loss = choose_loss(settings, train)
        noises = {
            view.name: given_noise(view, settings) or estimate_noise(target_of(view), view.step)
            for view in (*train.views, *test.views)
            if loss == "photon"
        }
        powers = [target.power for target in targets_of(train, loss, noises).values()]
        unit = float(torch.stack(powers).mean()) or 1.0
        support = find_support(train, settings)
        if support is not None:
            support.on(train.volume.grid)  # or there is nothing to find
        levels = factors(scene)
        return Problem(scene, settings, train, test, loss, noises, unit, support, levels)

    def at(self, level: int) -> Level:
        """The problem at a `level` of resolution, counted from the coarsest."""
        factor = self.factors[level]
        train, test = (scene_at_level(scene, factor) for scene in (self.train, self.test))
        if self.support is not None:
            cells = self.support.on(train.volume.grid)
            train, test = (
                replace(scene, volume=replace(scene.volume, support=cells))
                for scene in (train, test)
            )
        targets, shown = (targets_of(scene, self.loss, self.noises) for scene in (train, test))
        return Level(train, test, targets, shown)


@dataclass(frozen=True)
class Level:
    """A problem at one resolution: its scenes, and what their views are compared with, by name."""

    train: Scene
    test: Scene
    targets: Mapping[str, Target]
    test_targets: Mapping[str, Target]


def select_views(scene: Scene, is_test: bool) -> Scene:
    """`scene` with a volume of its own and those test, or training, views that have an image."""
    views = [view for view in scene.views if view.image is not None and view.is_test == is_test]
    return replace(scene, views=views, volume=replace(scene.volume))


def require_usable(train: Scene, settings: OptimizeSettings) -> None:
    """Raises SceneError where `settings` cannot be reconstructed from the views of `train`.

    Reasons are: no views, no light, a parameter that touches no view, or a target that is not
    finite. Raises FormatError where pictures are black, or masks leave no pixel.
    """
    if not train.views:
        raise SceneError(
            "views: none has split: train and an image; there is nothing to reconstruct from"
        )
    if not any(bool(view.seen.any()) for view in train.views):
        raise FormatError(
            "views",
            "no training picture shows anything where its pixels count; masks are white there",
        )
    if _is_dark(train, settings):
        raise SceneError(
            "lights: none shines, and none is optimized: give one a brightness above 0,"
            " or the volume an emission"
        )
    problems = [
        f"optimize.parameters.{name}: there is no training view of this name with an image"
        for name in sorted(settings.parameters.keys() - variable_names(train))
    ]
    for view in train.views:
        if place := describe_flaw("the image", target_of(view), is_field=False):
            problems.append(f"views.{view.name}: {place} is not finite")
    if problems:
        raise SceneError(problems)


def _is_dark(train: Scene, settings: OptimizeSettings) -> bool:
    """Whether there is nothing to be seen: nothing shines, glows or is optimized, no background."""
    glows = (train.volume.emission, train.volume.black_body)
    if "emission" in settings.parameters or any(x is not None and bool(x.any()) for x in glows):
        return False
    has_light = any(
        all(bool(value.any()) for name, value in vars(light).items() if name in BRIGHTNESS)
        for light in train.lights
    )
    seeks_light = any(name.startswith("lights.") for name in settings.parameters)
    behind = [view.background for view in train.views if view.background is not None]
    return not (has_light or seeks_light or any(bool(radiance.any()) for radiance in behind))


def choose_loss(settings: OptimizeSettings, train: Scene) -> str:
    """The loss that `settings` ask for, or that fits the pictures of the views of `train`.

    `display` fits pictures stored as sRGB values, `l2` linear ones. Raises SceneError where there
    are both.
    """
    if settings.loss is not None:
        return settings.loss
    encoded = [view.name for view in train.views if view.step]
    linear = [view.name for view in train.views if not view.step]
    if encoded and linear:
        raise SceneError(
            f"optimize.loss: some training pictures are sRGB files ({encoded[0]}), others linear"
            f" ({linear[0]}); say how to compare them, loss: display or loss: l2"
        )
    return "display" if encoded else "l2"


def given_noise(view: View, settings: OptimizeSettings) -> Noise | None:
    """The noise of the picture of `view`, as its scene says."""
    noise = settings.noise
    return Noise(noise.read, noise.shot, view.step) if noise else None


def targets_of(scene: Scene, loss: str, noises: Mapping[str, Noise]) -> dict[str, Target]:
    """What the views of `scene` are compared with by `loss`, by name."""
    return {
        view.name: Target.of(target_of(view), view.mask, loss, noises.get(view.name))
        for view in scene.views
    }


def start_parameters(scene: Scene, settings: OptimizeSettings) -> list[Parameter]:
    """The parameters that `settings` name, at the values from which `scene` starts them."""
    starts = {
        name: scene.starts[name] if name in scene.starts else value_of(scene, name)
        for name in settings.parameters
    }
    started = with_values(scene, starts)
    parameters = [
        Parameter(name, settings.parameters[name], start, scene.volume.grid, unit_of(started, name))
        for name, start in starts.items()
    ]
    fields = [p for p in parameters if p.is_field]
    densities = {p.name.removesuffix("density"): p for p in fields if p.key == "density"}
    for p in fields:
        medium = densities.get(p.name.removesuffix("emission"))
        if p.key == "emission" and medium is not None and (p.low, p.high) == (0, math.inf):
            p.glow_in(medium)
    if len(fields) == 1 and settings.parameters[fields[0].name].tv is None:
        fields[0].tv *= kind_of(fields[0].name).alone
    return parameters


def factors(scene: Scene) -> list[int]:
    """The coarsening factor of each level of resolution, coarsest first, the last of them 1.

    They are powers of two that leave the grid's shortest side `FEWEST_CELLS`.
    """
    most = max(min(scene.volume.grid.shape) // tuning.FEWEST_CELLS, 1)
    return [2**k for k in reversed(range(most.bit_length()))]


def scene_at_level(scene: Scene, factor: int) -> Scene:
    """`scene` with about `factor` times fewer cells and pixels a side; targets are averaged.

    A pixel is the mean of those in it that count, and counts where more than half of them do.
    Of pixels it has as many fewer again as leave a cell `CELL` of them wide: more say no more.
    """
    views = [_view_at_level(view, factor, scene.volume.grid) for view in scene.views]
    if factor == 1:
        return replace(scene, views=views)
    volume, grid = scene.volume, scene.volume.grid.coarsen(factor)
    coarse = volume_at_level(volume, grid)
    starts = {
        name: resample(start, grid) if start.shape[-3:] == volume.grid.shape else start
        for name, start in scene.starts.items()
    }
    return replace(scene, volume=coarse, views=views, starts=starts)


def _view_at_level(view: View, factor: int, grid: Grid) -> View:
    """`view` with up to `factor` times fewer pixels a side than cells of `grid` ask for."""
    factor *= max(1, int(cell_width(grid, view.camera) / CELL))
    most = max(1, min(factor, min(view.camera.size) // tuning.FEWEST_PIXELS))
    if most == 1:
        return view
    camera, image, mask = view.camera.resize(most), view.image, view.mask
    background = view.background
    if background is not None and background.shape[1:] != (1, 1):
        background = adaptive_avg_pool2d(background, camera.size)
    share = None if mask is None else adaptive_avg_pool2d(mask[None], camera.size)[0]
    if image is not None:
        image = adaptive_avg_pool2d(image if mask is None else image * mask, camera.size)
        image = image if share is None else image / share.where(share > 0, 1)
    mask = None if share is None else (share > 0.5).to(share.dtype)
    return replace(view, camera=camera, image=image, mask=mask, background=background)
