"""Path-traced images (Mitsuba 3, extra `reference`), and how far ours are from them.

An image is traced in passes with seeds of their own, whose scatter tells how noisy their mean is.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.extras import load_extra
from ddrecon.io.images.table import write_picture, write_preview
from ddrecon.light.lights import BRIGHTNESS
from ddrecon.lighting import solve_light
from ddrecon.losses import Target
from ddrecon.picture import view_image
from ddrecon.progress import show_progress
from ddrecon.reference.mitsuba_scene import LONGEST, is_gray, mitsuba_scene, sensor_id
from ddrecon.report.pictures import comparison, diverging, pixels
from ddrecon.scene import Scene, View

PASSES = 8
"""Passes an image is traced in, whose scatter says how noisy it is; no more than paths a pixel."""
SEEDS = 2**30
"""Seeds that Mitsuba takes."""


@dataclass(frozen=True, eq=False)
class Tracer:
    """Mitsuba, and its `scenes`: one that colors share, or one for each of red, green and blue."""

    module: ModuleType
    scenes: tuple[Any, ...]

    def trace(self, view: int, seed: int, samples: int) -> np.ndarray:
        """The image [h, w, 3], float64, of view number `view` by `samples` paths a pixel.

        Each `seed` >= 0 has paths of its own.
        """
        images = []
        for index, scene in enumerate(self.scenes):
            (sensor,) = (s for s in scene.sensors() if s.id() == sensor_id(view))
            color_seed = len(self.scenes) * seed + index
            image = self.module.render(scene, sensor=sensor, seed=color_seed, spp=samples)
            images.append(np.array(image, np.float64))
        return images[0] if len(images) == 1 else np.stack([image.mean(-1) for image in images], -1)


def open_tracer(
    scene: Scene, views: Sequence[View], depth: int = -1, threads: int | None = None
) -> Tracer:
    """What traces `views` of `scene`, by paths of at most `depth` segments, -1 for no limit.

    It takes `threads` threads (None: all). Colors whose extinctions or phase functions differ are
    traced one by one.
    Raises MissingExtraError without Mitsuba, SceneError for what it cannot show.
    """
    module = load_mitsuba(threads)
    is_shared = is_gray(scene.volume) and scene.volume.phase.colors == 1
    scenes = [scene] if is_shared else [pick_color(scene, color) for color in range(3)]
    described = (make_mitsuba_objects(module, mitsuba_scene(s, views, depth)) for s in scenes)
    return Tracer(module, tuple(map(module.load_dict, described)))


def load_mitsuba(threads: int | None = None) -> ModuleType:
    """Mitsuba, on `threads` threads (None: all); it is quiet but for errors.

    Its variant is `llvm_ad_rgb` where DRJIT_LIBLLVM_PATH names an LLVM, else `scalar_rgb`. Raises
    MissingExtraError where it is not installed.
    """
    mitsuba = load_extra("mitsuba", "the reference renderer")
    mitsuba.set_variant("llvm_ad_rgb" if os.environ.get("DRJIT_LIBLLVM_PATH") else "scalar_rgb")
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    if threads is not None:
        import drjit

        drjit.set_thread_count(threads)
    return mitsuba


def make_mitsuba_objects(module: ModuleType, value: Any) -> Any:
    """A description by `mitsuba_scene` with Mitsuba's own objects in it."""
    if isinstance(value, dict):
        return {key: make_mitsuba_objects(module, entry) for key, entry in value.items()}
    if isinstance(value, tuple):
        return {"type": "rgb", "value": list(value)}
    if isinstance(value, np.ndarray):
        return {2: module.ScalarTransform4f, 3: module.Bitmap, 4: module.VolumeGrid}[value.ndim](
            value
        )
    return value


@dataclass(frozen=True, eq=False)
class Traced:
    """The mean `image` [h, w] or [h, w, 3] of several passes, and its `noise`.

    `noise` is the standard error of the pixels (root mean square), relative to the root mean square
    of the image; 0 for a black image.
    """

    image: np.ndarray
    noise: float

    @staticmethod
    def of(passes: Sequence[np.ndarray]) -> Traced:
        """What at least two `passes` say together."""
        image = np.mean(passes, 0)
        variance = (np.var(passes, axis=0, ddof=1) / len(passes)).mean()
        return Traced(image, math.sqrt(variance / _power(image)))

    def distance(self, image: np.ndarray) -> float:
        """The root mean square of the difference to `image`, relative to this one's."""
        return math.sqrt(((image - self.image) ** 2).mean() / _power(self.image))

    def error(self, image: np.ndarray) -> float:
        """The `distance` of `image` less the noise, in quadrature; at least 0.

        That is what would be left were this image free of noise.
        """
        return math.sqrt(max(0.0, self.distance(image) ** 2 - self.noise**2))


def error_text(error: float, noise: float) -> str:
    """`error` against a reference of this `noise`, with "<" where it cannot be told from none."""
    return f"{error:.3g}" if error >= noise / 3 else f"< {noise / 3:.2g}"


def _power(image: np.ndarray) -> float:
    return max(float((image**2).mean()), float(np.finfo(np.float64).tiny))


def pick_color(scene: Scene, color: int) -> Scene:
    """`scene` as seen in `color` alone: 0, 1, 2 for red, green, blue.

    Paths that colors share are chosen by the extinction of one of them and weighted for the others.
    Where extinctions differ that makes five times the noise, and Mitsuba 3.9 drops samples whose
    weight comes out a rounding below zero, so there each color is traced by itself.

    Views keep their cameras only.
    """
    volume = scene.volume
    volume = replace(
        volume,
        sigma_a=_pick(volume.sigma_a, color),
        sigma_s=_pick(volume.sigma_s, color),
        phase=volume.phase.map(partial(_pick_number, color=color)),
    )
    lights = []
    for light in scene.lights:
        colors = {k: v for k, v in vars(light).items() if k in BRIGHTNESS and v.ndim}
        picked: Any = {name: _pick(value, color) for name, value in colors.items()}
        lights.append(replace(light, **picked))
    ground = scene.ground
    if ground is not None:
        ground = replace(ground, albedo=_pick(ground.albedo, color))
    return replace(scene, volume=volume, lights=lights, ground=ground)


def _pick_number(number: Tensor, color: int) -> Tensor:
    """The entry of `color` in a `number` [3, ...] of a phase function; others, and cells, as they
    are.
    """
    is_colored = number.shape[:1] == (3,) and number.ndim != 3
    return _pick(number, color) if is_colored else number


def _pick(value: Tensor, color: int) -> Tensor:
    """The entry of `value` [C, ...] that belongs to `color`, still with a leading axis."""
    index = color % value.shape[0]
    return value[index : index + 1]


def compare_to_folder(
    tracer: Tracer,
    scene: Scene | None,
    views: Sequence[View],
    folder: Path,
    samples: int,
    seed: int,
) -> dict[str, Any]:
    """Writes traced and our own images of `views` of `scene`, and returns a report with our errors.

    They are NAME.reference.*, NAME.ours.*, NAME.difference.* (ours less the reference) and
    NAME.comparison.png in `folder`; without `scene` the traced ones alone, NAME.*. `tracer` must be
    of these views, and each is traced with `samples` >= 2 paths a pixel.
    """
    passes = min(PASSES, samples)
    samples_per_pass = -(-samples // passes)
    settings = {
        "samples_per_pixel": passes * samples_per_pass,
        "passes": passes,
        "seed": seed,
        "variant": tracer.module.variant(),
        "integrator": "volpath",
        "longest_path": LONGEST,
        "russian_roulette": False,
        "colors_traced_apart": len(tracer.scenes) > 1,
    }
    report: dict[str, Any] = {"settings": settings, "views": {}, "files": {}}
    if scene is not None:
        start = perf_counter()
        with torch.no_grad():
            light_field = solve_light(scene, SolveMemory())
        report["seconds"] = {"light": perf_counter() - start}
    for index, view in enumerate(views):
        start = perf_counter()
        seeds = [(seed * passes + number) % SEEDS for number in range(passes)]
        pass_seeds = show_progress(seeds, view.name)
        traced = Traced.of([tracer.trace(index, number, samples_per_pass) for number in pass_seeds])
        seconds = {"reference": perf_counter() - start}
        measured: dict[str, Any] = {"noise": traced.noise, "seconds": seconds}
        if scene is None:
            written = write_picture(folder / view.name, traced.image)
        else:
            start = perf_counter()
            with torch.no_grad():
                ours = view_image(light_field, scene, view.camera).cpu()
            seconds["ours"] = perf_counter() - start
            theirs = torch.from_numpy(traced.image).permute(2, 0, 1).to(ours)
            image, mean = pixels(ours).astype(np.float64), float(traced.image.mean())
            measured |= {
                "error": traced.error(image),
                "distance": traced.distance(image),
                "psnr": float(Target.of(theirs, None).psnr_of(ours)),
                "brightness": float(image.mean()) / mean if mean > 0 else None,
            }
            written = _write(folder / view.name, ours, theirs)
        report["views"][view.name] = measured
        report["files"][view.name] = [path.name for path in written]
    return report


def _write(stem: Path, ours: Tensor, theirs: Tensor) -> list[Path]:
    difference = ours - theirs
    pictures: dict[str, tuple[np.ndarray, np.ndarray | None]] = {
        "reference": (pixels(theirs), None),
        "ours": (pixels(ours), None),
        "difference": (pixels(difference), diverging(difference)[0]),
    }
    beside = stem.with_name(f"{stem.name}.comparison.png")
    write_preview(beside, comparison(theirs, ours))
    written = [
        path
        for kind, (array, preview) in pictures.items()
        for path in write_picture(Path(f"{stem}.{kind}"), array, preview)
    ]
    return [*written, beside]


def reference_lines(report: dict[str, Any]) -> list[str]:
    """How far ours is from theirs, and how long both took, as `reference` prints it."""
    lines = []
    for name, view in report["views"].items():
        noise, notes = view["noise"], [f"noise {view['noise']:.3f}"]
        if "error" in view:
            distance = f"with the reference's noise, {noise:.3f}: {view['distance']:.3f}"
            error = f"relative RMS error {error_text(view['error'], noise)} ({distance})"
            notes = [error, f"PSNR {view['psnr']:.1f} dB"]
            if view["brightness"] is not None:
                notes.append(f"brightness {view['brightness']:.3f} of the reference's")
        times = ", ".join(f"{who} {seconds:.2f} s" for who, seconds in view["seconds"].items())
        lines.append(f"{name}: {', '.join(notes)} ({times})")
    samples, mitsuba = report["settings"]["samples_per_pixel"], report["environment"]["mitsuba"]
    return [*lines, f"{samples} paths a pixel, Mitsuba {mitsuba}"]
