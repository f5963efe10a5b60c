"""Which scenes can be rendered: records of the right types, numbers that a scene file may have."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from itertools import chain

import torch
from torch import Tensor

from ddrecon.errors import UsageError
from ddrecon.records import faults_of
from ddrecon.scene import Scene, View
from ddrecon.settings import LENSES
from ddrecon.variables.kinds import EXTINCTION_AND_ALBEDO, RESPONSE, STEEPEST_G, kind_of, split_name
from ddrecon.variables.values import find_readers, require_form, require_shape

RIGID = 0.01
"""How far from 1 and 0 products of a pose's axes may be: optimizers and halves round."""
KEYS = tuple(key.name for key in fields(Scene) if key.name != "views")


def require_scene(scene: object) -> None:
    """Raises UsageError unless `scene` is one."""
    if not isinstance(scene, Scene):
        kind = type(scene).__name__
        raise UsageError(f"expected a Scene, found {kind}; ddrecon.load_scene(path) reads one")


def require_legal(scene: Scene, view: str | None = None) -> None:
    """Raises UsageError where a number of `scene` is none that a scene file may have.

    That is one of its volume, its lights or its views (of the one named `view`, or all) of a wrong
    type, shape, precision or device, one that is not finite, or out of range, such as a density
    below 0. Numbers on a GPU are not looked at: that would wait for them.
    """
    require_scene(scene)
    views = scene.views if view is None else [scene.view(view)]
    faults = faults_of(scene)
    if view is not None:
        faults = chain(faults_of(scene, keys=KEYS), faults_of(views[0], f"views.{view}"))
    for key, fault in faults:
        raise UsageError(f"{key}: {fault}")
    cells, density = scene.volume.grid.shape, scene.volume.density
    if density.is_meta:
        raise UsageError("density: has no numbers on the device meta")
    require_shape("volume.support", scene.volume.support, cells)
    for item in views:
        _require_view(item)
    for name, value in _numbers_of(scene, views).items():
        require_form(name, value, value, density, cells)
        if value.is_cpu:
            _require_range(name, value)


def _require_range(name: str, value: Tensor) -> None:
    """Raises UsageError where `value` is not finite, or out of range for the variable `name`."""
    kind = kind_of(name)
    least, most = (float(end) for end in value.detach().aminmax())
    range_found = f"found {least:g}" if least == most else f"found {least:g} to {most:g}"
    if not math.isfinite(least + most):
        raise UsageError(f"{name}: must be finite, {range_found}")
    if kind.high == STEEPEST_G and not -1 < least <= most < 1:
        # A scene may scatter further forward than a run makes it.
        raise UsageError(f"{name}: must be above -1 and below 1, {range_found}")
    if kind.high != STEEPEST_G and not kind.low <= least <= most <= kind.high:
        bounds = f"at least {kind.low:g}" if kind.high == math.inf else f"from 0 to {kind.high:g}"
        raise UsageError(f"{name}: must be {bounds}, {range_found}")
    if kind.is_direction and least == most == 0:
        raise UsageError(f"{name}: must not be zero")


def _numbers_of(scene: Scene, views: Sequence[View]) -> dict[str, Tensor]:
    """All that can be varied of `scene` and its `views`, by name, as it is stored."""
    numbers: dict[str, object] = {
        name: read()
        for name, read in find_readers(scene).items()
        if not name.startswith("views.") and split_name(name)[1] not in EXTINCTION_AND_ALBEDO
    }
    for view in views:
        camera, owner = view.camera, f"views.{view.name}."
        numbers |= {owner + key: getattr(view, key) for key in RESPONSE}
        numbers |= {owner + "camera": camera.pose, owner + "distortion": camera.distortion}
        numbers[owner + "principal_point"] = camera.principal_point
    return {name: value for name, value in numbers.items() if isinstance(value, Tensor)}


def _require_view(view: View) -> None:
    """Raises UsageError where what is not varied of `view` cannot be: shapes, its pose and lens."""
    owner, camera, lens = f"views.{view.name}.", view.camera, view.camera.lens
    pose, half, size = camera.pose, torch.as_tensor(camera.half_width).detach(), camera.size
    require_shape(f"{owner}camera.pose", pose, (3, 4))
    if half.is_cpu and not 0 < float(half) < math.inf:
        rule = "half_width, 1 / (2 focal), must be above 0 and finite"
        raise UsageError(f"{owner}camera: {rule}, found {float(half):g}")
    if pose.is_cpu and not _is_rigid(pose.detach()):
        rule = "the first three columns of its pose must be of unit length and perpendicular"
        raise UsageError(f"{owner}camera: {rule}, and not mirror")
    if (lens is None) != (camera.distortion is None):
        raise UsageError(f"{owner}camera: give both lens and distortion, or neither")
    if lens is not None:
        require_shape(f"{owner}distortion", camera.distortion, (len(LENSES[lens]),))
    require_shape(f"{owner}image", view.image, (3, *size))
    require_shape(f"{owner}mask", view.mask, size)
    shapes = [(colors, *tail) for colors in (1, 3) for tail in ((1, 1), size)]
    require_shape(f"{owner}background", view.background, *shapes)
    behind = view.background
    if behind is not None and behind.is_cpu and not bool(behind.isfinite().all()):
        raise UsageError(f"{owner}background: must be finite")


def _is_rigid(pose: Tensor) -> bool:
    """Whether `pose` turns and shifts; NaN is for others to tell."""
    axes = pose[:, :3]
    off = (axes.T @ axes - torch.eye(3).to(pose)).abs().max()
    return not (float(off) > RIGID or float(axes.det()) < 0)
