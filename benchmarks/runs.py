"""Reconstructions whose iterations `speed.py`, `launches.py` and `gpu_check.py` time and count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from figures import ROOT
from torch import Tensor

from ddrecon.bench import plume_scene
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.io.volumes.table import read_field
from ddrecon.picture import render_each
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.setup import scene_at_level
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.settings import OptimizeSettings, ParameterSettings

CONFIGS = ROOT / "configs"


def start_run(scene: Scene, names: Sequence[str] = ("density",)) -> Reconstruction:
    """A run that seeks the fields `names` of `scene`, from half of each and its own images."""
    # A medium that is sought is received in whole cells, whatever this one deserves.
    scene = replace(scene, diffusion=replace(scene.diffusion, receive=1))
    with torch.no_grad():
        images = render_each(scene, scene.views, SolveMemory())
    views = [replace(view, image=image) for view, image in zip(scene.views, images, strict=True)]
    fields = {name: ParameterSettings(field=True) for name in names}
    settings = OptimizeSettings(fields, iterations=1000)
    starts = {name: 0.5 * getattr(scene.volume, name) for name in names}
    return Reconstruction(replace(scene, views=views, optimize=settings, starts=starts))


def start_paper_case(
    cells: int, pixels: int, rounds: int, device: str | torch.device = "cpu"
) -> Reconstruction:
    """The gray plume of `bench` in one view; without `rounds` it is the paper's case."""
    scene = plume_scene(cells, pixels, torch.float32, torch.device(device))
    settings = replace(scene.diffusion, transport_rounds=rounds)
    return start_run(replace(scene, diffusion=settings))


def start_config(name: str, device: str | torch.device = "cpu", factor: int = 1) -> Reconstruction:
    """`configs/NAME.yaml` as it is, in cells so many times as wide."""
    return Reconstruction(
        scene_at_level(load_scene(CONFIGS / f"{name}.yaml", device=device), factor)
    )


def start_plume(device: str | torch.device = "cpu", factor: int = 1) -> Reconstruction:
    """`configs/plume.yaml` from half the truth, by three views, in cells so many times as wide."""
    scene = load_scene(CONFIGS / "plume.yaml", device=device)
    views = [view for view in scene.views if not view.is_test][:3]
    starts = {"density": 0.5 * read_plume().to(scene.volume.density)}
    return Reconstruction(scene_at_level(replace(scene, views=views, starts=starts), factor))


def read_plume() -> Tensor:
    """The true density of `configs/plume.yaml`."""
    return torch.tensor(read_field(ROOT / "data/plume/density.npz", "density").values)


def apart(result: Tensor, reference: Tensor) -> float:
    """How far two tensors are apart, relative to the second."""
    return float((result.cpu() - reference.cpu()).norm() / reference.norm().clamp(min=1e-300))
