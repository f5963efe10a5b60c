"""Both engines compute the same images and derivatives, of configs and of random scenes."""

from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import Phase, given, settings
from hypothesis import strategies as some
from media import half_empty, make_camera, make_scene, random_values
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import ENGINES, use_engine
from ddrecon.light.lights import BeamLight, EnvironmentLight, PointLight
from ddrecon.picture import render_each
from ddrecon.reconstruct.levels import scene_at_level
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.settings import DiffusionSettings, RenderSettings
from ddrecon.variables.values import value_of, variable_names, with_values

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("few_directions")]

ROOT = Path(__file__).parents[1]
ALIKE = ("film", "noisy", "plume", "satellite", "fig06_light", "fig07", "fig08", "fig09")
ALIKE += ("fig12_single", "fig13", "fire", "ground", "cloud")
"""Configs whose lights, media and settings are of the kinds of others."""
CONFIGS = sorted(one for one in (ROOT / "configs").rglob("*.yaml") if one.stem not in ALIKE)
CLOSE = {torch.float32: 1e-5, torch.float64: 1e-11}
SOLVED = {torch.float32: 1e-7, torch.float64: 1e-14}
"""Both solve as closely as numbers allow: what is compared is no solver's stopping."""
MOST_CELLS = 8


def variables_of(scene: Scene) -> list[str]:
    """All but those that others are made of."""
    return [name for name in variable_names(scene) if name not in ("sigma_t", "albedo")]


def outcome(scene: Scene, names: Sequence[str], engine: str, first: int = 0) -> list[Tensor]:
    """The images, and derivatives by `names` of a sum of pixels, weighted by the seed `first`."""
    use_engine(engine)
    values = {name: value_of(scene, name).detach().clone().requires_grad_() for name in names}
    changed = with_values(scene, values)
    images = render_each(changed, changed.views, SolveMemory())
    total = sum(
        (image * random_values(*image.shape, seed=seed, dtype=image.dtype)).sum()
        for seed, image in enumerate(images, first)
    )
    bars = torch.autograd.grad(total, list(values.values()), allow_unused=True)
    zeros = (torch.zeros_like(value) for value in values.values())
    pairs = zip(bars, zeros, strict=True)
    return [*(image.detach() for image in images), *(z if bar is None else bar for bar, z in pairs)]


def assert_engines_agree(scene: Scene, names: Sequence[str]) -> None:
    """To `CLOSE`; where numbers of 32 bits do not tell so much, to what they do tell.

    That is how far either engine's result is from its own in 64 bits, at worst for three sums of
    pixels: of one alone, errors may cancel by chance.
    """
    known, found = (outcome(scene, names, engine) for engine in ENGINES)
    labels = [*(view.name for view in scene.views), *names]
    close = CLOSE[scene.volume.density.dtype]
    for index, (label, one, other) in enumerate(zip(labels, known, found, strict=True)):
        apart, size = float((one - other).norm()), float(one.norm())
        if apart > close * size and one.dtype == torch.float32:
            size += 2 * max(rounding(scene, names, seed)[index] for seed in (0, 10, 20)) / close
        assert apart <= close * size, f"{label}: {apart:.2e} of {size:.2e}"


def rounding(scene: Scene, names: Sequence[str], first: int) -> list[float]:
    """How far the `outcome` of `scene` is from that in 64 bits, by the worse of both engines."""
    scenes = scene, in_double(scene)
    pairs = ([outcome(each, names, engine, first) for each in scenes] for engine in ENGINES)
    found = ([float((a - b).norm()) for a, b in zip(*pair, strict=True)] for pair in pairs)
    return [max(both) for both in zip(*found, strict=True)]


def in_double(record: Any) -> Any:
    """The same scene in 64 bits."""
    if isinstance(record, Tensor):
        return record.double()
    if isinstance(record, (list, tuple)):
        return type(record)(in_double(entry) for entry in record)
    if not is_dataclass(record):
        return record
    changes = {part.name: in_double(getattr(record, part.name)) for part in fields(record)}
    if isinstance(record, DiffusionSettings):
        changes["tolerance"] = SOLVED[torch.float64]
    return replace(record, **changes)


@pytest.mark.parametrize("config", CONFIGS, ids=lambda path: path.stem)
def test_engines_agree_on_every_kind_of_config(config: Path) -> None:
    scene = load_scene(config, dtype=torch.float64)
    factor = -(-max(scene.volume.grid.shape) // MOST_CELLS)
    scene = scene_at_level(replace(scene, views=scene.views[:2]), factor)
    volume = replace(scene.volume, density=half_empty(*scene.volume.grid.shape))
    diffusion = replace(scene.diffusion, tolerance=SOLVED[torch.float64])
    scene = replace(scene, volume=volume, diffusion=diffusion)
    assert_engines_agree(scene, variables_of(scene))


MEDIA = {
    "gray": {"sigma_a": (1.0,), "sigma_s": (6.0,)},
    "colored": {},
    "cellwise": {},
    "black": {"sigma_s": (0.0,), "model": "none"},
}
"""Kinds of media; fused kernels are compiled for each, and for each kind of lights."""
LIGHTS = {
    "beam": {},
    "gray beam": {"directional": (2.0,)},
    "ambient": {"directional": None, "ambient": (0.4, 0.3, 0.2)},
    "points": {"ambient": (0.3,)},
    "sky": {"directional": None},
}
KINDS = [("gray", "gray beam"), ("colored", "beam"), ("colored", "sky"), ("black", "points")]
KINDS += [("cellwise", "points"), ("cellwise", "ambient")]
VIEWS = {
    "far": {"eye": (0.3, 0.4, 3.0), "half_width": 0.25},
    "near": {"eye": (1.1, 0.5, 0.9), "half_width": 0.9},
    "inside": {"eye": (0.1, 0.12, 0.05), "half_width": 0.6},
    "parallel": {"eye": (0.7, -0.4, 2.5), "half_width": 0.8, "is_perspective": False},
}


@some.composite
def scenes(draw: Any, dtype: torch.dtype) -> Scene:
    """A small scene; its numbers come from seeds, its kind and settings one by one."""
    kind, lit = draw(some.sampled_from(KINDS))
    shape = tuple(draw(some.integers(2, 9)) for _ in range(3))
    seed = draw(some.integers(0, 99))
    density = draw(some.sampled_from([0.0, 0.3, 2.0])) * half_empty(*shape, seed=seed, dtype=dtype)
    size = (draw(some.integers(2, 24)), draw(some.integers(2, 24)))
    view = VIEWS[draw(some.sampled_from(sorted(VIEWS)))]
    # Flux-limited diffusion is solved as closely in 64 bits only.
    models = ["p1"] if dtype == torch.float32 else ["p1", "p1", "flux_limited"]
    model = draw(some.sampled_from(models))
    changes = {"model": model, **MEDIA[kind], **LIGHTS[lit]}
    if changes["model"] == "p1":
        changes["transport_rounds"] = draw(some.integers(0, 2))
        changes["closure"] = draw(some.sampled_from(["geometric", "smooth"]))
    if kind == "cellwise":
        for step, (name, most) in enumerate((("sigma_a", 1.0), ("sigma_s", 6.0)), 1):
            changes[name] = most * random_values(3, *shape, seed=seed + step, dtype=dtype)
    scene = make_scene(
        density,
        g=draw(some.sampled_from([0.0, 0.4, 0.85, -0.3])),
        camera=make_camera(size=size, dtype=dtype, **view),
        tolerance=SOLVED[dtype],
        **changes,
    )
    tensor = density.new_tensor
    if lit == "points":
        beam = tensor([0.1, 1.0, 0.05]), tensor([-0.2, -1.0, -0.1]), tensor([0.5]), tensor(0.2)
        scene.lights += [
            PointLight(tensor([0.9, 0.7, 0.2]), tensor([1.0, 2.0, 0.5])),
            PointLight(tensor([0.1, 0.05, -0.1]), tensor([0.3])),
            BeamLight(*beam),
        ]
    if lit == "sky":
        sky = random_values(3, 4, 8, seed=seed + 3, dtype=dtype)
        scene.lights.append(EnvironmentLight(sky, tensor(0.5), tensor(20.0), 6))
    render = RenderSettings(
        samples_per_pixel=draw(some.sampled_from([1, 2])),
        steps_per_voxel=draw(some.sampled_from([1, 2])),
        tolerance=draw(some.sampled_from([0.0, 1.0])),
    )
    return replace(scene, render=render)


@pytest.mark.parametrize(("dtype", "count"), [(torch.float32, 1), (torch.float64, 4)])
def test_engines_agree_on_scenes_drawn_at_random(dtype: torch.dtype, count: int) -> None:
    @settings(max_examples=count, derandomize=True, database=None, phases=[Phase.generate])
    @given(scene=scenes(dtype), has_moved=some.booleans())
    def check(scene: Scene, has_moved: bool) -> None:
        names = variables_of(scene)
        still = [name for name in names if not name.endswith("camera")]
        assert_engines_agree(scene, names if has_moved else still)

    check()
