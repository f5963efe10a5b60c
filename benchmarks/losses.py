"""What the plume comes to by each loss, from 8-bit and linear pictures: a table of
docs/settings.md.

python benchmarks/losses.py [full] [half]

`full` is `configs/plume.yaml` as it is, `half` has half its pixels and cells. 8-bit pictures are
the path-traced ones encoded by sRGB; all are judged by the path-traced ones themselves.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

import imageio.v3 as imageio
import torch
from torch import Tensor

from ddrecon.io.images.srgb import encode_bytes
from ddrecon.losses import Target
from ddrecon.reconstruct.levels import scene_at_level
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.renderer import render
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "configs/plume.yaml"
EIGHT_BIT = [("8-bit", loss) for loss in ("l2", "display", "photon")]
CASES = {
    "full": [*EIGHT_BIT, ("linear", "l2"), ("linear", "display")],
    "half": EIGHT_BIT,
}
"""Pictures and losses, by size."""


def overrides_of(true: Scene, pictures: str, folder: Path) -> Iterator[str]:
    """What makes the plume's config one of the views of `true`, encoded where `pictures` ask so."""
    yield f"volume.resolution={[*reversed(true.volume.grid.shape)]}"
    for number, view in enumerate(true.views):
        yield f"views.{number}.camera.resolution={[*view.camera.size]}"
        if pictures == "8-bit":
            path = folder / f"{view.name}.png"
            imageio.imwrite(path, encode_bytes(view.image.permute(1, 2, 0).numpy()))
            yield f"views.{number}.image={path}"


def judge(found: Scene, true: Scene) -> tuple[float, float, float]:
    """PSNRs [dB] of held-out views, linear and displayed, and the relative L1 error of density."""
    tests = [view for view in true.views if view.is_test]
    with torch.no_grad():
        images = [render(found, view.name)[0] for view in tests]
    linear, displayed = (
        sum(
            float(Target.of(view.image, None, loss).psnr_of(image))
            for view, image in zip(tests, images, strict=True)
        )
        / len(tests)
        for loss in ("l2", "display")
    )
    return linear, displayed, error_of(found.volume.density, true.volume.density)


def error_of(density: Tensor, true: Tensor) -> float:
    """The relative L1 error of `density`."""
    return float((density - true).abs().sum() / true.sum())


def main() -> None:
    """Prints a row for each case."""
    parser = argparse.ArgumentParser()
    parser.add_argument("sizes", nargs="*", default=[*CASES], metavar="full|half")
    arguments = parser.parse_args()
    full = load_scene(CONFIG, overrides=["volume.density={file: ../data/plume/density.npz}"])
    print("| | held out, linear | held out, displayed | L1 error of density |\n|---|---|---|---|")
    for size in arguments.sizes:
        true = full if size == "full" else scene_at_level(full, 2)
        for pictures, loss in CASES[size]:
            with tempfile.TemporaryDirectory() as folder:
                overrides = [*overrides_of(true, pictures, Path(folder)), f"optimize.loss={loss}"]
                scene = load_scene(CONFIG, overrides=overrides)
            if pictures == "linear":
                scene.views[:] = true.views
            run = Reconstruction(scene)
            while not run.is_done:
                run.step()
            linear, displayed, error = judge(run.current_scene(), true)
            words = f"{size} size, {pictures} pictures, `{loss}`"
            print(f"| {words} | {linear:.2f} dB | {displayed:.2f} dB | {error:.3f} |", flush=True)


if __name__ == "__main__":
    main()
