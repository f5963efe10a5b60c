"""Scenes as tensors: shapes and values, and files that do not fit the scene or cannot be used."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from example_scene import SCENE, changed

from ddrecon import defaults
from ddrecon.errors import SceneError
from ddrecon.io.volumes.table import write_field, write_fields
from ddrecon.scene_file.build import load_scene
from ddrecon.scene_file.load import describe, dump_scene, read_scene

Write = Callable[[str], Path]
BOUNDS = np.array([[-0.5, -0.75, -0.5], [0.5, 0.75, 0.5]])
VOLUME = yaml.safe_load(SCENE)["volume"]
VIEW = yaml.safe_load(SCENE)["views"][0]


def volume(left_out: tuple[str, ...] = (), **changes: Any) -> str:
    section = VOLUME | changes
    return changed(volume={name: section[name] for name in section if name not in left_out})


def view(camera: dict[str, Any] | None = None, **changes: Any) -> str:
    return changed(views=[VIEW | changes | ({"camera": camera} if camera else {})])


def problems(path: Path, *overrides: str) -> list[str]:
    with pytest.raises(SceneError) as caught:
        load_scene(path, overrides=overrides)
    return [line.replace(f"{path.parent}/", "") for line in caught.value.problems]


def save_field(folder: Path, name: str, *shape: int, bounds: np.ndarray = BOUNDS) -> np.ndarray:
    values = np.random.default_rng(0).random(shape).astype(np.float32)
    write_field(folder / f"{name}.npz", name, values, bounds)
    return values


def test_constants(write: Write):
    scene = load_scene(write(SCENE))
    assert scene.volume.grid.shape == (4, 3, 2)
    assert scene.volume.grid.bounds_xyz == ((-0.5, -0.75, -0.5), (0.5, 0.75, 0.5))
    assert torch.equal(scene.volume.density, torch.full((4, 3, 2), 0.1))
    assert scene.volume.sigma_a.tolist() == pytest.approx([0.6] * 3)
    assert scene.volume.sigma_s.tolist() == pytest.approx([11.4, 10.8, 9.6])
    assert scene.volume.g.item() == pytest.approx(0.3) and scene.volume.g.ndim == 0
    assert scene.path is not None and scene.path.name == "scene.yaml" and scene.optimize is None


CHOSEN = [(0.3, 0.5, False, (1, 1, 1)), (0.3, 0.5, True, (2, 5, 1)), (0.8, 0.5, False, (3, 3, 1))]
CHOSEN += [(0.8, 4, False, (3, 3, 3)), (0.8, 50, False, (1, 3, 9)), (0.8, 0.5, True, (4, 5, 1))]
CHOSEN += [(0.8, 50, True, (5, 5, 9)), (-0.8, 3, False, (4, 5, 3))]


@pytest.mark.parametrize("g, depth, is_flat, expected", CHOSEN, ids=str)
def test_rounds_and_degree_follow_from_the_phase_function_and_the_medium(
    tmp_path: Path, write: Write, g: float, depth: float, is_flat: bool, expected: tuple[int, ...]
):
    """Cells are `depth` optical depths thick; all of them, or one that no face of the box has."""
    values = np.full((5, 5, 5), depth, np.float32)
    if not is_flat:
        values *= np.arange(125).reshape(5, 5, 5) == 62
    write_field(tmp_path / "body.npz", "density", values, BOUNDS)
    density, size = {"file": "body.npz"}, (0.2 + 0.3 + 0.2) / 3
    text = volume(g=g, sigma_a=0.1 / size, sigma_s=0.9 / size, density=density, resolution=[5] * 3)
    scene = load_scene(write(text))
    found = scene.diffusion
    assert (found.rounds, found.angles, found.times) == expected
    is_thick = depth / found.times > (0.75 if is_flat else 1.5)
    assert found.receive == (3 if is_thick else 1)
    parts = ", receive 3" * is_thick
    assert f"refine {found.times}{parts}: a second moment of {g * g:.2g}" in scene.reason
    chosen = load_scene(write(text), overrides=("diffusion.degree=5",)).diffusion
    assert (chosen.rounds, chosen.angles) == (expected[0], 5)
    glowing = load_scene(write(text), overrides=("volume.emission=1",)).diffusion
    # Not where cells are too thick for rounds to help.
    assert glowing.rounds == (1 if expected[0] == 1 and depth > 1 else max(expected[0], 2))
    fixed = load_scene(write(text), overrides=("diffusion.refine=1",))
    assert fixed.diffusion.times == 1 and "refine" not in fixed.reason


def test_cells_too_many_to_divide_stay_as_they_are_along_even_long_axes(
    write: Write, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(defaults, "MOST_CELLS", 300)
    bounds = {"min": [0, 0, 0], "max": [9, 1, 9]}
    scene = load_scene(write(volume(bounds=bounds, resolution=[9, 3, 3], density=50)))
    assert "refine 3, receive 3, refine_along y: " in scene.reason


def test_every_tensor_has_the_type_asked_for(write: Write):
    scene = load_scene(write(SCENE), dtype=torch.float64)
    volume, camera = scene.volume, scene.views[0].camera
    tensors = [volume.density, volume.sigma_a, volume.sigma_s, volume.g, camera.pose]
    tensors += [value for light in scene.lights for value in vars(light).values()]
    assert {tensor.dtype for tensor in tensors} == {torch.float64}
    assert volume.density.is_contiguous() and volume.sigma_a[0].item() == 0.6


def test_extinction_and_albedo(write: Write):
    scene = load_scene(write(volume(("sigma_a", "sigma_s"), sigma_t=12, albedo=[0.95, 0.9, 0.8])))
    assert scene.volume.sigma_a.tolist() == pytest.approx([0.6, 1.2, 2.4])
    assert scene.volume.sigma_s.tolist() == pytest.approx([11.4, 10.8, 9.6])


def test_fields_give_resolution_and_bounds_and_keep_their_order(write: Write, tmp_path: Path):
    density = save_field(tmp_path, "density", 5, 4, 3)
    sigma_s = save_field(tmp_path, "sigma_s", 5, 4, 3, 3)
    text = volume(
        ("resolution", "bounds"), density={"file": "density.npz"}, sigma_s={"file": "sigma_s.npz"}
    )
    scene = load_scene(write(text))
    assert scene.volume.grid.shape == (5, 4, 3)
    assert scene.volume.grid.bounds_xyz[1] == (0.5, 0.75, 0.5)
    assert np.array_equal(scene.volume.density, density) and scene.volume.sigma_a.shape == (3,)
    assert np.array_equal(scene.volume.sigma_s, np.moveaxis(sigma_s, -1, 0))
    assert scene.volume.sigma_s.is_contiguous()


def test_gray_fields_take_the_colors_of_constants(write: Write, tmp_path: Path):
    values = save_field(tmp_path, "albedo", 4, 3, 2)
    scene = load_scene(
        write(volume(("sigma_a", "sigma_s"), sigma_t=[1, 2, 3], albedo={"file": "albedo.npz"}))
    )
    for color in range(3):
        assert np.allclose(scene.volume.sigma_s[color], (color + 1) * values)
        assert np.allclose(scene.volume.sigma_a[color], (color + 1) * (1 - values), atol=1e-6)


def test_values_by_label_are_those_of_fields(write: Write, tmp_path: Path) -> None:
    """A table of optical properties, of whose rows each cell's label picks one."""
    labels = np.random.default_rng(3).integers(0, 3, (4, 3, 2))
    table = {"sigma_a": [[0, 0, 0], [1, 2, 3], 4], "sigma_s": [0.5, 0, 7], "g": [0, 0.9, -0.5]}
    np.savez(tmp_path / "mouse.npz", labels=labels.astype(np.uint8), bounds=BOUNDS)
    by_label, by_field = {}, {}
    for name, values in table.items():
        rows = np.stack(np.broadcast_arrays(*map(np.atleast_1d, values))).astype(np.float32)
        np.savez(tmp_path / f"{name}.npz", **{name: rows[labels].squeeze(), "bounds": BOUNDS})
        by_field[name] = {"file": f"{name}.npz"}
        by_label[name] = {"labels": "mouse.npz", "table": values}
    expected, found = (
        load_scene(write(volume(("resolution", "bounds"), density=1, **medium))).volume
        for medium in (by_field, by_label)
    )
    assert expected.grid == found.grid
    for name in ("density", "sigma_a", "sigma_s", "g"):
        assert torch.equal(getattr(found, name), getattr(expected, name))
    scene_file = read_scene(write(volume(("resolution", "bounds"), density=1, **by_label)))
    dump_scene(describe(scene_file), tmp_path / "again.yaml")
    assert torch.equal(load_scene(tmp_path / "again.yaml").volume.sigma_a, expected.sigma_a)


def test_an_absent_file_is_the_scenes_mistake(write: Write):
    path = write(
        SCENE.replace("{constant: 0.1}", "{file: none.npz}")
        + "optimize: {parameters: {density: {init: {file: no.npz}}}}\n"
    )
    assert problems(path, "views.0.image=no.exr", "views.0.mask=.") == [
        "scene.yaml:4:19: volume.density.file: none.npz does not exist",
        "-D views.0.image=no.exr: views.0.image: no.exr does not exist",
        f"-D views.0.mask=.: views.0.mask: {path.parent} is not a file",
        "scene.yaml:13:48: optimize.parameters.density.init.file: no.npz does not exist",
    ]


def test_bounds_agree_to_single_precision(write: Write, tmp_path: Path):
    save_field(tmp_path, "density", 4, 3, 2, bounds=BOUNDS * (1 + 1e-7))
    assert load_scene(write(volume(density={"file": "density.npz"}))).volume.density.shape[0] == 4


def test_images_become_channels_first_and_give_the_resolution(write: Write, tmp_path: Path):
    pixels = np.random.default_rng(0).random((6, 8, 3)).astype(np.float32)
    np.save(tmp_path / "a.npy", pixels)
    np.save(tmp_path / "m.npy", np.eye(6, 8))
    camera = {name: value for name, value in VIEW["camera"].items() if name != "resolution"}
    (built,) = load_scene(write(view(camera, image="a.npy", mask="m.npy", split="test"))).views
    assert built.image is not None and np.array_equal(built.image, np.moveaxis(pixels, -1, 0))
    assert built.mask is not None and np.array_equal(built.mask, np.eye(6, 8))
    assert built.camera.size == (6, 8) and built.is_test and built.name == "front"


def test_cameras(write: Write):
    (perspective,) = load_scene(write(SCENE)).views
    assert perspective.camera.half_width == pytest.approx(math.tan(math.radians(14)))
    assert perspective.camera.is_perspective
    assert perspective.camera.pose[:, 3].tolist() == pytest.approx([0, 0.3, 3.2])
    matrix = [[0, 0, 1, 2], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]
    flat = {"type": "orthographic", "width": 3, "pixel_aspect": 1.25, "resolution": [8, 6]}
    (orthographic,) = load_scene(write(view(flat | {"matrix": matrix}))).views
    assert orthographic.camera.half_width == 1.5 and not orthographic.camera.is_perspective
    assert orthographic.camera.pose.tolist() == matrix[:3]
    assert orthographic.camera.pixel_aspect == 1.25


def test_cameras_that_all_miss_the_volume_are_one_problem(write: Write):
    ring = {"count": 3, "radius": 3, "fov": 20, "target": [9, 0, 0], "resolution": [4, 4]}
    (line,) = problems(write(changed(views={"ring": ring})))
    assert line.startswith("scene.yaml:")
    assert "no pixel of view 'ring_00' and 2 more looks through the volume; the camera" in line


def test_a_field_may_have_another_name_in_its_file(write: Write, tmp_path: Path):
    """In the volume and where a parameter starts."""
    lwc, ice = np.random.default_rng(0).random((2, 4, 3, 2)).astype(np.float32)
    write_fields(tmp_path / "les.npz", {"lwc": lwc, "ice": ice}, BOUNDS)
    start = {"parameters": {"density": {"init": {"file": "les.npz", "name": "ice"}}}}
    scene = load_scene(
        write(
            changed(volume=VOLUME | {"density": {"file": "les.npz", "name": "lwc"}}, optimize=start)
        )
    )
    assert np.array_equal(scene.volume.density, lwc)
    assert np.array_equal(scene.starts["density"], ice)
