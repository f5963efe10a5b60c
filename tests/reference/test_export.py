"""Exported scenes are those that Mitsuba is given directly."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from media import make_camera, make_scene, random_values

from ddrecon.errors import UsageError
from ddrecon.io.volumes.table import read_field
from ddrecon.light.ground import Ground, Plane
from ddrecon.light.lights import AmbientLight, DirectionalLight, EnvironmentLight, Light, PointLight
from ddrecon.reference.exchange import export_scene
from ddrecon.reference.trace import Traced, open_tracer
from ddrecon.scene import View

pytestmark = pytest.mark.slow

NEEDED = "the reference needs Mitsuba 3 (the extra `reference`)"
COLOR = torch.tensor([3.0, 2.0, 1.0], dtype=torch.float64)
NEAR: list[Light] = [
    DirectionalLight(-COLOR, COLOR),
    PointLight(COLOR, 2 * COLOR),
    AmbientLight(COLOR),
]


OPEN = """
import sys
import numpy as np
from ddrecon.reference.trace import load_mitsuba
mitsuba = load_mitsuba(threads=2)
path, paths, *seeds = sys.argv[1:]
scene = mitsuba.load_file(path)
images = [mitsuba.render(scene, spp=int(paths), seed=int(seed)) for seed in seeds]
np.save(path + ".npy", np.array([np.array(image, np.float64) for image in images]))
"""


def opened(path: Path, paths: int, *seeds: int) -> np.ndarray:
    """The scene as a user's Mitsuba shows it by so many paths a pixel, a picture for each seed.

    In a process of its own, since after other scenes Mitsuba's EXR reader has hung.

    On two threads, as the tracer: random numbers of `scalar_rgb` depend on how many there are.
    """
    command = [sys.executable, "-c", OPEN, *map(str, (path, paths, *seeds))]
    subprocess.run(command, check=True, timeout=120)
    return np.load(f"{path}.npy")


def sky() -> EnvironmentLight:
    radiance = COLOR.view(3, 1, 1) * torch.arange(18, dtype=torch.float64).view(1, 3, 6)
    return EnvironmentLight(radiance, COLOR[2], 25 * COLOR[2])


@pytest.mark.parametrize("with_sky", [False, True])
def test_a_gray_scene_opened_is_the_scene_traced(tmp_path: Path, with_sky: bool) -> None:
    """Through a camera of either kind, by each light, over a ground."""
    pytest.importorskip("mitsuba", reason=NEEDED)
    lights = NEAR
    if with_sky:
        pytest.importorskip("OpenImageIO")
        lights = [*NEAR, sky()]
    camera = make_camera(eye=(2.0, 0.5, 0.1), is_perspective=with_sky, half_width=0.6)
    scene = make_scene(random_values(3, 4, 5), sigma_a=(1.0,), sigma_s=(4.0,), g=-0.4)
    ground = Ground(COLOR / 4, Plane(-0.7, 1))
    scene = replace(scene, lights=lights, views=[View("other", camera)], ground=ground)
    export_scene(scene, tmp_path / "scene.xml", may_exist=False)
    np.testing.assert_allclose(
        opened(tmp_path / "scene.xml", 16, 5)[0],
        open_tracer(scene, scene.views, threads=2).trace(0, 5, 16),
        rtol=1e-4,
    )


def test_a_colorful_scene_opened_is_the_scene_traced_to_noise(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba", reason=NEEDED)
    scene = make_scene(0.3 * random_values(3, 4, 5))
    export_scene(scene, tmp_path / "scene.xml", may_exist=False)
    tracer = open_tracer(scene, scene.views, threads=2)
    theirs = Traced.of([*opened(tmp_path / "scene.xml", 256, *range(3))])
    ours = Traced.of([tracer.trace(0, seed, 256) for seed in range(3)])
    assert max(theirs.noise, ours.noise) < 0.15
    assert ours.distance(theirs.image) < 1.5 * np.hypot(theirs.noise, ours.noise)


def test_what_is_there_stays(tmp_path: Path) -> None:
    scene, path = make_scene(random_values(3, 4, 5)), tmp_path / "scene.xml"
    (tmp_path / "scene.sigma_t.vol").write_text("mine")
    with pytest.raises(UsageError, match=r"scene.sigma_t.vol: already there"):
        export_scene(scene, path, may_exist=False)
    assert (tmp_path / "scene.sigma_t.vol").read_text() == "mine" and not path.exists()
    export_scene(scene, path, may_exist=True)
    assert read_field(tmp_path / "scene.sigma_t.vol", "sigma_t").resolution == (5, 4, 3)
