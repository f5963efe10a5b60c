"""Exported scenes are those that Mitsuba is given directly, and come back as they were."""

import re
import subprocess
import sys
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from media import make_camera, make_scene, random_values

from ddrecon.errors import DataWarning, FormatError, UsageError
from ddrecon.io.volumes.table import read_field
from ddrecon.light.ground import Ground, Plane
from ddrecon.light.lights import AmbientLight, DirectionalLight, EnvironmentLight, Light, PointLight
from ddrecon.reference.exchange import export_scene, import_scene
from ddrecon.reference.trace import open_tracer
from ddrecon.scene import View
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import cross_sections

pytest.importorskip("mitsuba", reason="Mitsuba's scenes need Mitsuba 3 (the extra `reference`)")
pytestmark = pytest.mark.slow

COLOR = torch.tensor([3.0, 2.0, 1.0], dtype=torch.float64)
SUN = DirectionalLight(-COLOR, COLOR)
NEAR: list[Light] = [SUN, PointLight(COLOR, 2 * COLOR), AmbientLight(COLOR)]


def sky(up):
    radiance = COLOR.view(3, 1, 1) * torch.arange(18, dtype=torch.float64).view(1, 3, 6)
    return EnvironmentLight(radiance, 2 * COLOR[2], 205 * COLOR[2], up=up)


def scene_of(lights, **medium):
    cameras = {
        name: make_camera(eye=(2.0, 0.5, 0.1), is_perspective=name == "front", half_width=0.6)
        for name in ("front", "plan")
    }
    cameras["front"].principal_point = torch.tensor([0.4, 0.7], dtype=torch.float64)
    views = [View(name, camera) for name, camera in cameras.items()]
    return replace(make_scene(random_values(3, 4, 5), g=-0.4, **medium), lights=lights, views=views)


def imported(scene, folder):
    export_scene(scene, folder / "scene.xml", may_exist=False)
    import_scene(folder / "scene.xml", folder / "again.yaml", may_exist=False)
    return load_scene(folder / "again.yaml", dtype=torch.float64)


def require_equal(first, second):
    """That two records of tensors and numbers hold the same, to single precision."""
    for field in fields(first):  # type: ignore[arg-type]
        a, b = (getattr(record, field.name) for record in (first, second))
        if isinstance(a, torch.Tensor | float | tuple):
            a, b = torch.broadcast_tensors(*(torch.as_tensor(x).double() for x in (a, b)))
            torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)
        else:
            assert a == b, field.name


def coefficients(volume):
    sigmas = torch.broadcast_tensors(volume.sigma_a, volume.sigma_s)
    shape = (-1, 1, 1, 1) if sigmas[0].ndim == 1 else sigmas[0].shape
    return torch.stack([volume.density * sigma.view(shape) for sigma in sigmas])


@pytest.mark.parametrize(
    "lights",
    [[SUN, PointLight(COLOR, 2 * COLOR), sky("y")], [SUN, sky("z")], [AmbientLight(COLOR)]],
)
def test_lights_and_cameras_come_back(tmp_path, lights):
    if any(isinstance(light, EnvironmentLight) for light in lights):
        pytest.importorskip("OpenImageIO")
    gray = torch.tensor([1.0]), torch.tensor([4.0])
    scene = scene_of(lights, sigma_a=gray[0], sigma_s=gray[1])
    again = imported(scene, tmp_path)
    found = {type(light): light for light in again.lights}
    assert len(found) == len(lights)
    for light in lights:
        other = found[type(light)]
        if isinstance(light, EnvironmentLight):  # Mitsuba has its scale in the pixels
            light = replace(light, radiance=light.radiance * light.scale, scale=COLOR[2])
            other = replace(other, rotation=other.rotation % 360)
        if isinstance(light, DirectionalLight):
            light = replace(light, direction=light.direction / light.direction.norm())
        require_equal(light, other)
    for view in again.views:
        (camera,) = (
            v.camera for v in scene.views if v.camera.is_perspective == view.camera.is_perspective
        )
        require_equal(camera, view.camera)


@pytest.mark.parametrize("colors", [1, 3])
@pytest.mark.parametrize("is_field", [False, True])
def test_media_come_back(tmp_path, colors, is_field):
    albedo = torch.tensor([0.9, 0.8, 0.7], dtype=torch.float64)[:colors]
    sigma_t = torch.full((colors,), 5.0, dtype=torch.float64)
    if is_field:
        albedo = albedo.view(-1, 1, 1, 1) * torch.ones(3, 4, 5, dtype=torch.float64)
        sigma_t = sigma_t.view(-1, 1, 1, 1) * (1 + random_values(colors, 3, 4, 5, seed=2))
    sigma_a, sigma_s = cross_sections(sigma_t, albedo)
    scene = scene_of([SUN], sigma_a=sigma_a, sigma_s=sigma_s)
    again = imported(scene, tmp_path)
    torch.testing.assert_close(
        *torch.broadcast_tensors(coefficients(scene.volume), coefficients(again.volume)),
        rtol=1e-5,
        atol=1e-5,
    )
    np.testing.assert_allclose(again.volume.grid.bounds_xyz, scene.volume.grid.bounds_xyz, 1e-6)
    moments = (volume.phase.moments(2) for volume in (again.volume, scene.volume))
    torch.testing.assert_close(*torch.broadcast_tensors(*moments), rtol=1e-6, atol=0)


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        (
            '<phase type="hg".*?</phase>',
            '<phase type="rayleigh"/>',
            "RayleighPhaseFunction: only hg",
        ),
        ('type="cube"', 'type="sphere"', "expected one cube with a medium inside"),
        (
            '<emitter type="dir.*?</emitter>',
            '<emitter type="spot"/>',
            "SpotLight: only directional",
        ),
        ('<scene version="', '<scene version="x', "[^\\n]+version[^\\n]+$"),
    ],
)
def test_what_is_not_read_is_named(tmp_path, old, new, fault):
    path = tmp_path / "scene.xml"
    export_scene(make_scene(random_values(3, 4, 5)), path, may_exist=False)
    text = path.read_text()
    assert re.search(old, text, re.DOTALL)
    path.write_text(re.sub(old, new, text, flags=re.DOTALL))
    with pytest.raises(FormatError, match=fault):
        import_scene(path, tmp_path / "again.yaml", may_exist=False)
    assert not (tmp_path / "again.yaml").exists()


def test_a_shape_without_a_medium_is_left_out_with_a_warning(tmp_path):
    path = tmp_path / "scene.xml"
    export_scene(make_scene(random_values(3, 4, 5)), path, may_exist=False)
    ball = '<shape type="sphere"/>\n</scene>'
    path.write_text(path.read_text().replace("</scene>", ball))
    with pytest.warns(DataWarning, match="left out: 1 shapes without a medium"):
        import_scene(path, tmp_path / "again.yaml", may_exist=False)


OPEN = """
import sys
import numpy as np
from ddrecon.reference.trace import load_mitsuba
mitsuba = load_mitsuba(threads=2)
path, paths, seed = sys.argv[1:]
scene = mitsuba.load_file(path)
image = mitsuba.render(scene, spp=int(paths), seed=int(seed))
np.save(path + ".npy", np.array(image, np.float64))
"""


def opened(path, paths, seed):
    """The scene as a user's Mitsuba shows it by so many paths a pixel.

    In a process of its own, since after other scenes Mitsuba's EXR reader has hung.

    On two threads, as the tracer: random numbers of `scalar_rgb` depend on how many there are.
    """
    command = [sys.executable, "-c", OPEN, *map(str, (path, paths, seed))]
    subprocess.run(command, check=True, timeout=120)
    return np.load(f"{path}.npy")


@pytest.mark.parametrize("with_sky", [False, True])
def test_a_gray_scene_opened_is_the_scene_traced(tmp_path, with_sky):
    """Through a camera of either kind, by each light, over a ground with and without a map."""
    lights, reflected = NEAR, COLOR / 4
    if with_sky:
        pytest.importorskip("OpenImageIO")
        lights, reflected = [*NEAR, sky("y")], random_values(3, 4, 2)
    camera = make_camera(eye=(2.0, 0.5, 0.1), is_perspective=with_sky, half_width=0.6)
    scene = make_scene(random_values(3, 4, 5), sigma_a=(1.0,), sigma_s=(4.0,), g=-0.4)
    ground = Ground(reflected, Plane(-0.7, 1))
    scene = replace(scene, lights=lights, views=[View("other", camera)], ground=ground)
    export_scene(scene, tmp_path / "scene.xml", may_exist=False)
    np.testing.assert_allclose(
        opened(tmp_path / "scene.xml", 16, 5),
        open_tracer(scene, scene.views, threads=2).trace(0, 5, 16),
        rtol=1e-4,
    )


def test_what_is_there_stays(tmp_path):
    scene, path = make_scene(random_values(3, 4, 5)), tmp_path / "scene.xml"
    (tmp_path / "scene.sigma_t.vol").write_text("mine")
    with pytest.raises(UsageError, match=r"scene.sigma_t.vol: already there"):
        export_scene(scene, path, may_exist=False)
    assert (tmp_path / "scene.sigma_t.vol").read_text() == "mine" and not path.exists()
    export_scene(scene, path, may_exist=True)
    assert read_field(tmp_path / "scene.sigma_t.vol", "sigma_t").resolution == (5, 4, 3)
