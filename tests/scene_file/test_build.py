"""Scenes as tensors: their settings, lights, colors and starts."""

import numpy as np
import pytest
import torch
from example_scene import BOUNDS, SCENE, SHAPE, TREE, VIEW, VOLUME, changed, volume

from ddrecon import defaults
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import DataWarning
from ddrecon.io.volumes.table import write_field, write_fields
from ddrecon.light.lights import BeamLight, EnvironmentLight, PointLight
from ddrecon.lighting import solve_light
from ddrecon.picture import render
from ddrecon.scene_file.build import build_scene, load_scene
from ddrecon.scene_file.load import describe, dump_scene, read_scene
from ddrecon.variables.values import value_of, with_values


def test_constants(load):
    scene = load(SCENE)
    medium, camera = scene.volume, scene.views[0].camera
    assert medium.grid.shape == SHAPE
    assert medium.grid.bounds_xyz == ((-0.5, -0.75, -0.5), (0.5, 0.75, 0.5))
    assert torch.equal(medium.density, torch.full(SHAPE, 0.1, dtype=torch.float64))
    assert medium.density.is_contiguous()
    assert medium.sigma_a.tolist() == [0.6] * 3 and medium.sigma_s.tolist() == [11.4, 10.8, 9.6]
    assert medium.g.item() == 0.3 and medium.g.ndim == 0
    assert scene.path is not None and scene.path.name == "scene.yaml" and scene.optimize is None
    tensors = [medium.density, medium.sigma_a, medium.sigma_s, medium.g, camera.pose]
    tensors += [value for light in scene.lights for value in vars(light).values()]
    assert {tensor.dtype for tensor in tensors} == {torch.float64}


CHOSEN = [(0.3, 0.5, True, (2, 5, 1)), (0.8, 4, False, (3, 3, 3)), (0.8, 50, False, (1, 3, 9))]
CHOSEN += [(0.8, 50, True, (5, 5, 9)), (-0.8, 3, False, (4, 5, 3))]


@pytest.mark.parametrize("g, depth, is_flat, expected", CHOSEN, ids=str)
def test_rounds_and_degree_follow_from_the_phase_function_and_the_medium(
    tmp_path, load, g, depth, is_flat, expected
):
    """Cells are `depth` optical depths thick; all of them, or one that no face of the box has."""
    values = np.full((5, 5, 5), depth, np.float32)
    if not is_flat:
        values *= np.arange(125).reshape(5, 5, 5) == 62
    write_field(tmp_path / "body.npz", "density", values, BOUNDS)
    density, size = {"file": "body.npz"}, (0.2 + 0.3 + 0.2) / 3
    text = volume(g=g, sigma_a=0.1 / size, sigma_s=0.9 / size, density=density, resolution=[5] * 3)
    scene = load(text)
    settings = scene.diffusion
    assert (settings.rounds, settings.angles, settings.times) == expected
    is_thick = depth / settings.times > (0.75 if is_flat else 1.5)
    assert settings.receive == (3 if is_thick else 1)
    parts = ", receive 3" * is_thick
    assert f"refine {settings.times}{parts}: a second moment of {g * g:.2g}" in scene.reason
    path = tmp_path / "scene.yaml"
    chosen = load_scene(path, overrides=("diffusion.degree=5",)).diffusion
    assert (chosen.rounds, chosen.angles) == (expected[0], 5)
    glowing = load_scene(path, overrides=("volume.emission=1",)).diffusion
    # Not where cells are too thick for rounds to help.
    assert glowing.rounds == (1 if expected[0] == 1 and depth > 1 else max(expected[0], 2))
    fixed = load_scene(path, overrides=("diffusion.refine=1",))
    assert fixed.diffusion.times == 1 and "refine" not in fixed.reason


def test_cells_too_many_to_divide_stay_as_they_are_along_even_long_axes(load, monkeypatch):
    monkeypatch.setattr(defaults, "MOST_CELLS", 300)
    bounds = {"min": [0, 0, 0], "max": [9, 1, 9]}
    scene = load(volume(bounds=bounds, resolution=[9, 3, 3], density=50))
    assert "refine 3, receive 3, refine_along y: " in scene.reason


# Lights


def test_lights_are_built_and_written_back(read, tmp_path):
    pixels = np.random.default_rng(0).random((4, 6, 3)).astype(np.float32)
    pixels[1, 2, 0] = pixels[2, 5, 2] = -1e-3
    np.save(tmp_path / "sky.npy", pixels)
    sky = {"type": "environment", "file": "sky.npy"}
    turn = {"scale": 2.5, "rotation": -370.0, "directions": 12, "up": "z"}
    point = {"type": "point", "position": [0, 2, -1]}
    lights = [sky, sky | turn, point | {"intensity": 5}, point | {"intensity": [1, 2, 3]}]
    lights.append(point | {"type": "beam", "direction": [0, -1, 0], "power": [1, 2, 3]})
    scene_file = read(changed(lights=lights))
    with pytest.warns(DataWarning, match="2 pixels with negative radiance are taken as 0"):
        plain, turned, gray, colored, pencil = build_scene(scene_file, dtype=torch.float64).lights
    assert isinstance(plain, EnvironmentLight) and isinstance(turned, EnvironmentLight)
    assert torch.equal(plain.radiance, torch.from_numpy(pixels.clip(0)).double().permute(2, 0, 1))
    numbers = turned.scale.item(), turned.rotation.item(), turned.directions, turned.up
    assert numbers == tuple(turn.values())
    assert (plain.scale, plain.rotation, plain.directions, plain.up) == (1, 0, 48, "y")
    assert isinstance(gray, PointLight) and isinstance(colored, PointLight)
    assert gray.position.tolist() == [0, 2, -1] and gray.intensity.tolist() == [5]
    assert colored.intensity.tolist() == [1, 2, 3]
    assert isinstance(pencil, BeamLight) and pencil.radius == 0
    assert pencil.power.tolist() == [1, 2, 3] and pencil.direction.tolist() == [0, -1, 0]
    dump_scene(describe(scene_file), tmp_path / "again.yaml")
    assert read_scene(tmp_path / "again.yaml").tree.lights == scene_file.tree.lights


# Equal colors are one channel of light, but for those that are optimized.

COLORS = {
    "sigma_a": 0.6,
    "sigma_s": 9.0,
    "phase.weight": 0.3,
    "lights.0.irradiance": 3.1,
    "lights.1.radiance": 0.3,
    "lights.2.intensity": 1.5,
}


def colored_text(folder, **more):
    """A scene whose colors are all three times those of `COLORS`, as in a gray sky."""
    pixels = np.random.default_rng(0).random((4, 8, 1)).astype(np.float32)
    np.save(folder / "sky.npy", pixels.repeat(3, 2))
    three = {name: [value] * 3 for name, value in COLORS.items()}
    phase = {"type": "two_lobe", "g": [0.5, -0.3], "weight": three["phase.weight"]}
    sections = {name: three[name] for name in ("sigma_a", "sigma_s")}
    lights = [
        TREE["lights"][0] | {"irradiance": three["lights.0.irradiance"]},
        {"type": "ambient", "radiance": three["lights.1.radiance"]},
        {"type": "point", "position": [1, 2, 1], "intensity": three["lights.2.intensity"]},
        {"type": "environment", "file": "sky.npy", "directions": 6},
    ]
    medium = {name: value for name, value in VOLUME.items() if name != "g"}
    views = [VIEW | {"background": [0.2, 0.2, 0.2]}]
    return changed(volume=medium | sections | {"phase": phase}, lights=lights, views=views, **more)


def test_equal_colors_are_one_channel_and_give_the_same_image(load, tmp_path):
    scene = load(colored_text(tmp_path))
    gray = {name: value_of(scene, name) for name in (*COLORS, "lights.3.radiance")}
    light = solve_light(scene, SolveMemory())
    assert len(light.diffuse[0]) == 1 and all(gray[name].numel() == 1 for name in COLORS)
    three = {name: torch.cat([torch.atleast_1d(value)] * 3) for name, value in gray.items()}
    colored = with_values(scene, three)
    assert len(solve_light(colored, SolveMemory()).diffuse[0]) == 3
    torch.testing.assert_close(render(scene), render(colored), rtol=1e-10, atol=0)


@pytest.mark.parametrize("name", [*COLORS, "sigma_t", "lights.3.radiance"])
def test_what_is_optimized_by_color_keeps_its_three(load, tmp_path, name):
    scene = load(colored_text(tmp_path, optimize={"parameters": {name: {}}}))
    assert value_of(scene, name).shape[0] == 3
    other = "lights.0.irradiance" if name != "lights.0.irradiance" else "lights.1.radiance"
    assert value_of(scene, other).shape == (1,)


# Where parameters start: from the scene, a number, a color, a list or a file.

COLORED = torch.tensor([1.0, 2, 3]).view(3, 1, 1, 1).expand(3, *SHAPE)


@pytest.mark.parametrize(
    ("name", "settings", "expected"),
    [
        ("density", "{}", torch.full(SHAPE, 0.1)),
        ("density", "{init: 0.3}", torch.full(SHAPE, 0.3)),
        ("density", "{init: {constant: 0.3}}", torch.full(SHAPE, 0.3)),
        ("density", "{init: 0.3, field: false}", 0.3),
        ("sigma_s", "{}", [11.4, 10.8, 9.6]),
        ("sigma_s", "{init: 2}", [2, 2, 2]),
        ("sigma_s", "{init: [1, 2, 3], field: true}", COLORED),
        ("sigma_t", "{}", [12.0, 11.4, 10.2]),
        ("albedo", "{init: 0.5}", [0.5, 0.5, 0.5]),
        ("g", "{init: -0.5}", -0.5),
        ("lights.0.irradiance", "{}", [3.14159]),
        ("lights.0.irradiance", "{init: [1, 2, 3]}", [1, 2, 3]),
        ("lights.0.direction", "{init: [0, -1, 0]}", [0, -1, 0]),
        ("views.front.camera", "{}", [0] * 6),
    ],
)
def test_a_start(load, name, settings, expected):
    starts = load(f"{SCENE}optimize: {{parameters: {{{name}: {settings}}}}}\n").starts
    assert list(starts) == [name]
    expected = torch.as_tensor(expected, dtype=torch.float64)
    torch.testing.assert_close(starts[name], expected, rtol=1e-6, atol=0)


@pytest.mark.parametrize(
    ("name", "colors"), [("density", None), ("sigma_a", None), ("sigma_a", 3), ("albedo", 3)]
)
def test_a_start_from_a_file(load, tmp_path, name, colors):
    shape = (*SHAPE, colors) if colors else SHAPE
    values = np.random.default_rng(0).random(shape).astype(np.float32)
    write_field(tmp_path / "start.npz", name, values, BOUNDS)
    start = f"{{parameters: {{{name}: {{init: {{file: start.npz}}}}}}}}"
    by_color = values.transpose(3, 0, 1, 2) if colors else values[None]
    expected = torch.from_numpy(values if name == "density" else by_color).double()
    assert torch.equal(load(f"{SCENE}optimize: {start}\n").starts[name], expected)


def test_a_field_may_have_another_name_in_its_file(load, tmp_path):
    """In the volume and where a parameter starts."""
    lwc, ice = np.random.default_rng(0).random((2, *SHAPE)).astype(np.float32)
    write_fields(tmp_path / "les.npz", {"lwc": lwc, "ice": ice}, BOUNDS)
    start = {"parameters": {"density": {"init": {"file": "les.npz", "name": "ice"}}}}
    medium = VOLUME | {"density": {"file": "les.npz", "name": "lwc"}}
    scene = load(changed(volume=medium, optimize=start))
    assert np.array_equal(scene.volume.density, lwc)
    assert np.array_equal(scene.starts["density"], ice)
