"""Path-traced images of gray scenes (Mitsuba 3, extra `reference`), kept in a folder so that a
second run is quick.

Passes of independent seeds are added until the noise of their mean is low enough.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from ddrecon.reference.trace import Traced, open_tracer
from ddrecon.scene import Scene

SAMPLES, LEAST = 128, 4
"""Paths a pixel in each pass, and the fewest passes."""


def trace(
    scene: Scene, folder: Path, depth: int = -1, noise: float = 0.03, passes: int = 32
) -> Traced:
    """The image [h, w] of the first view of `scene` by paths of at most `depth` segments (2:
    scattered once; -1: any number).

    Passes are made until their mean has so much `noise`, but no more than so many; what `folder`
    holds is taken from there.
    """
    path = folder / f"{_fingerprint(scene, depth)}.npz"
    images = list(np.load(path)["images"]) if path.exists() else []
    if not _is_enough(images, noise, passes):
        tracer = open_tracer(scene, scene.views[:1], depth)
        while not _is_enough(images, noise, passes):
            images.append(tracer.trace(0, len(images), SAMPLES).mean(-1))
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(path, images=np.array(images))
    return Traced.of(images)


def _is_enough(images: list[np.ndarray], noise: float, passes: int) -> bool:
    return len(images) >= LEAST and (len(images) >= passes or Traced.of(images).noise <= noise)


def _fingerprint(scene: Scene, depth: int) -> str:
    """A name for everything that the image depends on."""
    camera = scene.views[0].camera
    records: list[Any] = [scene.volume, camera, *scene.lights]
    values = [(type(record).__name__, *vars(record).values()) for record in records]
    text = repr(
        [[_as_plain_values(value) for value in record] for record in [*values, (depth, SAMPLES)]]
    )
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _as_plain_values(value: object) -> object:
    return (
        (tuple(value.shape), hashlib.sha256(value.numpy().tobytes()).hexdigest())
        if isinstance(value, Tensor)
        else value
    )
