"""Pictures of a scene as a camera would have them: our own renders, with noise."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

import ddrecon

CONFIGS = Path(__file__).parents[1] / "configs"
EXACT = ("diffusion.transport_rounds=4", "diffusion.degree=5", "render.samples_per_pixel=4")
"""More rounds, angles and samples than a reconstruction takes."""


def write_pictures(name: str, noise: float, truth: Sequence[str] = (), seed: int = 7) -> None:
    """Writes every picture of configs/NAME.yaml to data/NAME, of the scene that `truth` makes it.

    `noise` is that of a pixel as bright as the picture is on average; that of others is as photons
    have it.
    """
    config, folder = CONFIGS / f"{name}.yaml", Path(__file__).parent / name
    count = config.read_text().count("image:")
    none = [f"views.{number}.image=null" for number in range(count)]
    scene = ddrecon.load_scene(config, overrides=[*EXACT, *truth, *none])
    chance = np.random.default_rng(seed)
    with torch.no_grad():
        images = ddrecon.render(scene)
    for view, image in zip(scene.views, images, strict=True):
        bright = image.permute(1, 2, 0).numpy()
        some = noise * np.sqrt(bright * bright.mean()) * chance.normal(size=bright.shape)
        np.save(folder / f"{view.name}.npy", (bright + some).clip(0).astype(np.float16))
