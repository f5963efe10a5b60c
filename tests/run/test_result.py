"""The result of a run is a scene file that renders as what was found does."""

import numpy as np
import pytest
import torch
from small_scene import write_scene

from ddrecon.io.files.folders import RUN, claim_folder
from ddrecon.io.volumes.table import write_field
from ddrecon.numerics.autodiff import tensors_in
from ddrecon.picture import render
from ddrecon.run.result import RESULT
from ddrecon.run.run_folder import Run
from ddrecon.scene_file.build import build_scene, load_scene
from ddrecon.scene_file.load import describe, dump_scene, read_scene

MEDIA = "sigma_a: 0.5, sigma_s: [6, 5, 4]", "sigma_t: 7, albedo: [0.9, 0.8, 0.7]"
BOX = "bounds: {min: [-0.5, -0.4, -0.5], max: [0.5, 0.5, 0.6]}"
LIGHTS = """[{type: directional, direction: [-1, -2, -1], irradiance: 3},
 {type: environment, file: %s/sky.npy, scale: 0.5, rotation: 20, directions: 6},
 {type: point, position: [0.9, 0.8, 0.3], intensity: 1}]"""
FLAT = "{type: orthographic, origin: [2.5, 0, 0], target: [0, 0, 0], width: 1, resolution: [5, 4]}"
NUMBERS = """sigma_t: {}, g: {}, lights.0.irradiance: {init: [3, 2, 1]}, lights.0.direction: {},
 lights.1.radiance: {}, lights.1.scale: {}, lights.1.rotation: {},
 lights.2.position: {}, lights.2.intensity: {}, views.front.camera: {}"""
VARIED = [
    ("density: {init: 0.2}", ["density"]),
    ("sigma_a: {init: [0.5, 1, 2], field: true}, sigma_s: {}", ["sigma_a"]),
    ("albedo: {init: 0.8, field: true}, density: {}", ["density", "albedo"]),
    ("g: {init: 0.5, field: true}", ["g"]),
    (NUMBERS, []),
]


def moved(value):
    """`value` a little larger, everywhere by another amount."""
    generator = torch.Generator().manual_seed(0)
    random = torch.rand(value.shape, generator=generator, dtype=value.dtype)
    return value * (1.1 + 0.1 * random) + 0.01


def finished(folder, medium, parameters, phase="g: 0.3", start=()):
    """The scene found by a run in `folder`/out that ended, all its parameters moved."""
    path, random = write_scene(folder), np.random.default_rng(0)
    np.save(folder / "sky.npy", random.random((4, 8, 3), dtype=np.float32))
    overrides = [
        f"volume={{{BOX}, resolution: [6, 5, 4], density: 0.4, {medium}, {phase}}}",
        *(f"lights={LIGHTS % folder}", f"views.1={{name: side, camera: {FLAT}}}"),
        f"optimize={{iterations: 2, parameters: {{{parameters}}}}}",
        *start,
    ]
    dump_scene(describe(read_scene(path, overrides)), path)
    scene_file = read_scene(path)
    job = Run(build_scene(scene_file), scene_file, {})
    with claim_folder(folder / "out", RUN) as claimed:
        job.begin(claimed, is_resumed=False)
        job.step()
        for parameter in job.run.parameters:
            limit = 0.9 if parameter.name in ("albedo", "phase.weight") else torch.inf
            parameter.value = moved(parameter.value.detach()).clamp(max=limit)
        job.finish()
    return job.run.current_scene()


@pytest.mark.parametrize(
    ("number", "parameters", "fields"), [(i, *varied) for i, varied in enumerate(VARIED)]
)
def test_a_result_renders_as_what_was_found(tmp_path, number, parameters, fields):
    # Both ways to give cross sections, by turns.
    found = finished(tmp_path, MEDIA[number % 2], parameters)
    # Wherever its folder lies.
    folder = (tmp_path / "out").rename(tmp_path / "moved")
    again = load_scene(folder / RESULT)
    assert again.optimize is None and [view.name for view in again.views] == ["front", "side"]
    for view in ("front", "side"):
        wanted = render(found, view)
        assert torch.allclose(
            render(again, view), wanted, rtol=1e-4, atol=1e-5 * float(wanted.max())
        )
    assert {"density", *fields} <= {path.stem for path in (folder / "volumes").iterdir()}


LOBES = "{type: two_lobe, g: [0.6, -0.2], weight: [0.7, 0.5, 0.3]}"
PHASES = {"{type: henyey_greenstein, g: 0.3}": "g: {}", LOBES: "phase.g: {}, phase.weight: {}"}


@pytest.mark.parametrize(("phase", "parameters"), PHASES.items())
def test_a_result_has_the_phase_function_that_was_found(tmp_path, phase, parameters):
    found = finished(tmp_path, MEDIA[0], parameters, f"phase: {phase}").volume.phase
    again = load_scene(tmp_path / "out" / RESULT).volume.phase
    assert type(again) is type(found)
    for one, other in zip(tensors_in(again), tensors_in(found), strict=True):
        torch.testing.assert_close(one, other.detach(), rtol=1e-6, atol=0)


def test_a_volume_whose_box_its_file_gave_keeps_it(tmp_path):
    box = np.array([[-0.5, -0.4, -0.5], [0.5, 0.5, 0.6]])
    write_field(tmp_path / "start.npz", "density", np.full((4, 5, 6), 0.3), box)
    start = ["volume.bounds=~", "volume.resolution=~"]
    start.append(f"volume.density={{file: {tmp_path}/start.npz}}")
    found = finished(tmp_path, MEDIA[1], "density: {}", start=start)
    assert load_scene(tmp_path / "out" / RESULT).volume.grid == found.volume.grid
    assert found.volume.grid.shape == (4, 5, 6)
