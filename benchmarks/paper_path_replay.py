"""Fig. 7 of docs/experiments.md: density from one picture, by us and by path replay backpropagation in Mitsuba 3, 64 paths a pixel.

    DRJIT_LIBLLVM_PATH=... python benchmarks/paper_path_replay.py [-o FOLDER] [--iterations 40] [--times 3]

Both look at the picture of configs/paper/fig07.yaml in pixels `--times` times as large, start from the same density, and step by Adam at
the same rates against the same loss, ours without its total variation.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
import torch
from paper_figures import Array, projected, save, show
from torch import Tensor

from ddrecon.bench.path_tracing import DENSITY
from ddrecon.io.volumes import read_field
from ddrecon.reconstruct.loop import optimize
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.rates import rate_at
from ddrecon.reference.mitsuba_scene import LONGEST
from ddrecon.reference.trace import open_tracer
from ddrecon.scene.build import load_scene
from ddrecon.scene.schema import ParameterSettings
from ddrecon.world import Scene

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "configs" / "paper" / "fig07.yaml"
PICTURE = ROOT / "docs" / "pictures" / "paper" / "fig07.png"
TARGET = ROOT / "data" / "paper" / "fig07" / "front.npy"
PATHS, RATE = 64, 0.1
Steps = list[tuple[float, float]]
"""Seconds since the start, and the loss, of each iteration."""


def smaller(picture: Array, times: int) -> Array:
    """`picture` [h, w, 3] in pixels `times` times as large."""
    height, width = (size // times for size in picture.shape[:2])
    mean: Array = picture[: height * times, : width * times].reshape(height, times, width, times, 3).mean((1, 3))
    return mean


def by_us(scene: Scene) -> tuple[Steps, Array]:
    """Our reconstruction: its steps, and its density [z, y, x]."""
    result = optimize(scene)
    return [(row.seconds, row.loss) for row in result.rows], result.scene.volume.density.numpy()


def by_path_replay(scene: Scene, target: Array, iterations: int) -> tuple[Steps, Array]:
    """The same by path replay; its losses are those of noisy pictures."""
    parameter = Parameter("density", ParameterSettings(min=0, tv=0), RATE, scene.starts["density"], scene.volume.grid)
    differentiate = path_replay(scene, target)
    start, steps = time.perf_counter(), []
    for iteration in range(iterations):
        loss, gradient = differentiate(parameter.value.detach(), iteration)
        parameter.step(gradient, rate_at(iteration, iterations))
        steps.append((time.perf_counter() - start, loss))
        print(f"path replay {iteration + 1}: {steps[-1][0]:.1f} s, loss {loss:.3g}", flush=True)
    return steps, parameter.value.detach().numpy()


def path_replay(scene: Scene, target: Array) -> Callable[[Tensor, int], tuple[float, Tensor]]:
    """What makes the loss and its derivative by density [z, y, x] from that density and a seed."""
    import drjit

    tracer = open_tracer(scene, scene.views[:1], threads=torch.get_num_threads())
    mitsuba, (loaded,) = tracer.module, tracer.scenes
    integrator = mitsuba.load_dict({"type": "prbvolpath", "max_depth": LONGEST, "rr_depth": 2 * LONGEST})
    parameters, wanted = mitsuba.traverse(loaded), mitsuba.TensorXf(target)
    (name,) = (key for key in parameters.keys() if key.endswith(DENSITY))  # noqa: SIM118 - Mitsuba's own mapping

    def differentiate(density: Tensor, seed: int) -> tuple[float, Tensor]:
        parameters[name] = mitsuba.TensorXf(density.numpy()[..., None])
        drjit.enable_grad(parameters[name])
        parameters.update()
        image = mitsuba.render(loaded, parameters, integrator=integrator, sensor=0, seed=seed, spp=PATHS)
        loss = drjit.mean(drjit.square(image - wanted), axis=None)
        drjit.backward(loss)
        gradient = np.array(drjit.grad(parameters[name]), np.float32).reshape(density.shape)
        return float(np.array(loss).item()), torch.from_numpy(gradient)

    return differentiate


def draw(found: dict[str, tuple[Steps, Array]], truth: Array) -> None:
    """Writes the picture: loss against iteration and against time, and the density along z."""
    figure, axes = plt.subplots(1, 5, figsize=(12, 2.9), layout="constrained", width_ratios=(1.5, 1.5, 1, 1, 1))
    for name, (steps, _) in found.items():
        seconds, losses = zip(*steps, strict=True)
        axes[0].semilogy(range(1, len(losses) + 1), losses, label=name)
        axes[1].loglog(seconds, losses, label=name)
    axes[0].set_title("loss against iteration", fontsize=9)
    axes[1].set_title("loss against seconds", fontsize=9)
    axes[0].legend(fontsize=7)
    fields = {"truth": truth} | {name: density for name, (_, density) in found.items()}
    for axis, (name, field) in zip(axes[2:], fields.items(), strict=True):
        show(axis, projected(field, 0, 1), float(projected(truth, 0, 1).max()))
        axis.set_title(f"density along z:\n{name}", fontsize=8)
    save(figure, PICTURE)


def main() -> None:
    """Draws the picture and prints what each took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "runs" / "paper" / "fig07")
    parser.add_argument("--iterations", type=int, default=40)
    parser.add_argument("--times", type=int, default=3)
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    target = smaller(np.load(TARGET).astype(np.float32), given.times)
    np.save(given.output / "front.npy", target)
    settings = {"iterations": given.iterations, "parameters.density.tv": 0, "parameters.density.lr": RATE}
    overrides = [f"views.0.image={(given.output / 'front.npy').resolve()}", *(f"optimize.{key}={value}" for key, value in settings.items())]
    scene = load_scene(CONFIG, overrides=overrides)
    scene.views = scene.views[:1]
    found = {"ours": by_us(scene), "path replay": by_path_replay(scene, target, given.iterations)}
    truth = read_field(ROOT / "data" / "shapes" / "cloud.npz", "density").values
    for name, (steps, density) in found.items():
        error = float(np.abs(projected(density, 0, 1) - projected(truth, 0, 1)).sum() / projected(truth, 0, 1).sum())
        print(f"{name}: {steps[-1][0]:.1f} s, loss {steps[-1][1]:.3g}, relative L1 error of the density along z {error:.2f}")
    draw(found, truth)


if __name__ == "__main__":
    main()
