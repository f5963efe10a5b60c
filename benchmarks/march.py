"""View rays by a lattice: error and time over `render.tolerance`, against nothing but the
interpolation of every pixel's samples.

    python benchmarks/march.py [--pixels 512] [--repeat 3] [--threads 1]

The scene is the plume of configs/plume.yaml in one color, its light solved beforehand; times are
processor time of image and derivative by density, masses and diffuse light, the least of
interleaved runs, as parts of that of a ray for every pixel.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from ddrecon.cameras import Camera, cast_rays, look_at
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.march.bands import Bands
from ddrecon.march.box import cross_box
from ddrecon.march.emission import Channels
from ddrecon.march.samplers import choose_way, make_sampler
from ddrecon.numerics.interpolation import sample_slices
from ddrecon.renderer import LightField, solve_light, view_image
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.settings import RenderSettings

ROOT = Path(__file__).parents[1]
TOLERANCES = (0.0, 0.01, 0.03, 0.05, 0.1, 1.0)
VIEWS = {"front": (0.0, 0.3, 3.2), "corner": (2.0, 1.6, 2.0), "near": (0.9, 0.1, 0.6)}
SIGMAS = (10.0, 100.0)


@dataclass(frozen=True)
class Case:
    """One view: the scene with `leaves` in its light field, by which images are differentiated."""

    scene: Scene
    light: LightField
    leaves: tuple[Tensor, ...]
    camera: Camera

    def image(self, tolerance: float) -> tuple[Tensor, Tensor]:
        """The image and its derivatives, flattened together."""
        image = view_image(
            self.light, replace(self.scene, render=RenderSettings(tolerance=tolerance)), self.camera
        )
        bars = torch.autograd.grad(image.square().mean(), self.leaves)
        return image.detach(), torch.cat([bar.flatten() / bar.norm() for bar in bars])

    def interpolated(self) -> None:
        """What every pixel's ray interpolates, there and back, and nothing else."""
        grid, bundle = self.scene.volume.grid, cast_rays(self.camera)
        crossing = cross_box(grid, bundle)
        fields = torch.cat([leaf.detach() for leaf in self.leaves])
        sampler = make_sampler(Channels([fields]), grid, choose_way(grid, bundle, crossing), 1)
        if not isinstance(sampler, Bands):
            raise SystemExit("the view is not one by slices")
        whole = sampler.slices
        for chunk in torch.arange(len(crossing.hit)).split((1 << 18) // sampler.nodes):
            chosen = bundle.select(crossing.hit[chunk])
            distance = whole.distances(chosen.origin, chosen.direction)
            places = chosen.origin + distance[..., None] * chosen.direction
            points = (
                2 * (places - places.new_tensor(grid.lower)) / places.new_tensor(grid.extent) - 1
            )
            slices = torch.cat(whole.bands, 2).requires_grad_()
            across = [axis for axis in (2, 1, 0) if axis != whole.axis]
            sample_slices(slices, points[..., across].contiguous()).sum().backward()


def case(sigma_t: float, eye: tuple[float, float, float], pixels: int) -> Case:
    """The plume of so much extinction from one place, close enough to fill the image."""
    overrides = [
        f"volume.density={{file: {ROOT / 'data/plume/density.npz'}}}",
        f"volume.sigma_t={sigma_t}",
        "volume.albedo=0.9",
    ]
    scene = load_scene(
        ROOT / "configs/plume.yaml",
        overrides=[*overrides, "volume.g=0", "optimize.parameters.density={}"],
    )
    with torch.no_grad():
        light = solve_light(scene, SolveMemory())
    density = light.medium.extinction.field.requires_grad_()
    coefficients = {
        name: replace(getattr(light.medium, name), field=density)
        for name in ("extinction", "scattering", "absorption")
    }
    origin = torch.tensor(eye)
    half_width = 0.25 if origin.norm() > 2 else 0.47
    camera = Camera(
        look_at(origin, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])), (pixels, pixels), half_width
    )
    leaves = density, light.beams[0].mass.requires_grad_(), light.diffuse.mean.requires_grad_()
    return Case(scene, replace(light, medium=replace(light.medium, **coefficients)), leaves, camera)


def least_seconds(runs: dict[str, Callable[[], object]], repeat: int) -> dict[str, float]:
    """The least processor time of each of `runs`, gone through in turn."""
    least = dict.fromkeys(runs, float("inf"))
    for _ in range(repeat):
        for name, run in runs.items():
            start = time.process_time()
            run()
            least[name] = min(least[name], time.process_time() - start)
    return least


def main() -> None:
    """Prints one row per case and tolerance."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--pixels", type=int, default=512)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    print(
        "| sigma_t, view | tolerance | error of the image | of the derivative | time | time, in "
        "interpolations of every pixel |"
    )
    print("|---|---|---|---|---|---|")
    for sigma_t in SIGMAS:
        for name, eye in VIEWS.items():
            view = case(sigma_t, eye, args.pixels)
            results = {tolerance: view.image(tolerance) for tolerance in TOLERANCES}
            runs = {str(tolerance): partial(view.image, tolerance) for tolerance in TOLERANCES}
            seconds = least_seconds({"floor": view.interpolated} | runs, args.repeat)
            for tolerance, result in results.items():
                errors = [
                    float((a - b).norm() / b.norm())
                    for a, b in zip(result, results[0.0], strict=True)
                ]
                time_part, floors = (
                    seconds[str(tolerance)] / seconds[key] for key in ("0.0", "floor")
                )
                row = (
                    f"{100 * errors[0]:.2f} % | {100 * errors[1]:.1f} % | {time_part:.2f} | "
                    f"{floors:.2f}"
                )
                print(f"| {sigma_t:g}, {name} | {tolerance:g} | {row} |", flush=True)


if __name__ == "__main__":
    main()
