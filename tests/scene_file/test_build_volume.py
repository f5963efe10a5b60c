"""The volume section as tensors: numbers, colors, files, labels, phase functions, two media."""

import re
from typing import Any

import numpy as np
import pytest
import torch
from example_scene import BOUNDS, SHAPE, VOLUME, changed, volume

from ddrecon.errors import DataWarning, FormatError, SceneError
from ddrecon.io.volumes.table import write_field
from ddrecon.medium.coefficients import mix_media
from ddrecon.medium.phase import Blend, HenyeyGreenstein, Rayleigh, Tabulated, TwoLobe
from ddrecon.numerics.autodiff import tensors_in
from ddrecon.run.result import describe_result, result_names
from ddrecon.scene_file.build import build_scene, load_scene
from ddrecon.scene_file.load import describe, dump_scene
from ddrecon.variables.values import value_of

PAIR = ("sigma_a", "sigma_s")


def save_field(folder, name, *shape, bounds=BOUNDS):
    values = np.random.default_rng(0).random(shape).astype(np.float32)
    write_field(folder / f"{name}.npz", name, values, bounds)
    return values


def loaded_again(scene_file):
    """The scene of the file that is written for it."""
    path = scene_file.path.with_name("again.yaml")
    dump_scene(describe(scene_file), path)
    return load_scene(path)


def test_extinction_and_albedo(load):
    medium = load(volume(PAIR, sigma_t=12, albedo=[0.95, 0.9, 0.8])).volume
    assert medium.sigma_a.tolist() == pytest.approx([0.6, 1.2, 2.4])
    assert medium.sigma_s.tolist() == pytest.approx([11.4, 10.8, 9.6])


def test_fields_give_resolution_and_bounds_and_keep_their_order(load, tmp_path):
    density = save_field(tmp_path, "density", 5, 4, 3)
    sigma_s = save_field(tmp_path, "sigma_s", 5, 4, 3, 3)
    files = {name: {"file": f"{name}.npz"} for name in ("density", "sigma_s")}
    medium = load(volume(("resolution", "bounds"), **files)).volume
    assert medium.grid.shape == (5, 4, 3) and medium.grid.bounds_xyz[1] == (0.5, 0.75, 0.5)
    assert np.array_equal(medium.density, density) and medium.sigma_a.shape == (3,)
    assert np.array_equal(medium.sigma_s, np.moveaxis(sigma_s, -1, 0))
    assert medium.sigma_s.is_contiguous()


def test_bounds_agree_to_single_precision(load, tmp_path):
    save_field(tmp_path, "density", *SHAPE, bounds=BOUNDS * (1 + 1e-7))
    assert load(volume(density={"file": "density.npz"})).volume.density.shape == SHAPE


def test_gray_fields_take_the_colors_of_constants(load, tmp_path):
    values = save_field(tmp_path, "albedo", *SHAPE)
    medium = load(volume(PAIR, sigma_t=[1, 2, 3], albedo={"file": "albedo.npz"})).volume
    for color in range(3):
        assert np.allclose(medium.sigma_s[color], (color + 1) * values)
        assert np.allclose(medium.sigma_a[color], (color + 1) * (1 - values), atol=1e-6)


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_values_by_height_are_linear_between_them_and_even_beyond(load, up):
    """A ramp that ends within the box, of one number and of colors."""
    gas = {"heights": [-0.25, 0.25], "values": [[1, 2, 3], 1]}
    density = {"heights": [-9, 9], "values": [0, 18]}
    medium = load(volume((), density=density, sigma_a=gas, up=up), dtype=torch.float64).volume
    place = medium.grid.centers(medium.density)["zyx".index(up)]
    torch.testing.assert_close(medium.density, (place + 9).expand(SHAPE))
    fraction = (0.5 + 2 * place).clamp(0, 1)
    expected = torch.stack([top + (1 - top) * fraction for top in (1, 2, 3)]).expand(3, *SHAPE)
    torch.testing.assert_close(medium.sigma_a, expected)


def test_values_by_label_are_those_of_fields(read, tmp_path):
    """A table of optical properties, of whose rows each cell's label picks one."""
    labels = np.random.default_rng(3).integers(0, 3, SHAPE)
    table = {"sigma_a": [[0, 0, 0], [1, 2, 3], 4], "sigma_s": [0.5, 0, 7], "g": [0, 0.9, -0.5]}
    np.savez(tmp_path / "mouse.npz", labels=labels.astype(np.uint8), bounds=BOUNDS)
    by_label, by_field = {}, {}
    for name, values in table.items():
        rows = np.stack(np.broadcast_arrays(*map(np.atleast_1d, values))).astype(np.float32)
        np.savez(tmp_path / f"{name}.npz", **{name: rows[labels].squeeze(), "bounds": BOUNDS})
        by_field[name] = {"file": f"{name}.npz"}
        by_label[name] = {"labels": "mouse.npz", "table": values}
    left_out = "resolution", "bounds"
    expected = build_scene(read(volume(left_out, density=1, **by_field))).volume
    scene_file = read(volume(left_out, density=1, **by_label))
    for medium in (build_scene(scene_file).volume, loaded_again(scene_file).volume):
        assert medium.grid == expected.grid
        for name in ("density", "sigma_a", "sigma_s", "g"):
            assert torch.equal(getattr(medium, name), getattr(expected, name))


# Phase functions

BARE = {name: value for name, value in VOLUME.items() if name != "g"}
PHASES: dict[str, tuple[type, dict[str, Any]]] = {
    "henyey_greenstein": (HenyeyGreenstein, {"g": [0.8, 0.7, 0.6]}),
    "two_lobe": (TwoLobe, {"g": [0.8, -0.3], "weight": 0.7}),
    "rayleigh": (Rayleigh, {}),
    "table": (Tabulated, {"file": "table.csv"}),
}


def scene_with(**phase):
    return changed(volume=BARE | {"phase": phase})


def write_table(folder, scale=1.0):
    """Rayleigh's phase function, times `scale`."""
    degrees = np.arange(0, 181, 5)
    values = scale * 0.75 * (1 + np.cos(np.radians(degrees)) ** 2)
    rows = [f"{angle}, {value}" for angle, value in zip(degrees, values, strict=True)]
    (folder / "table.csv").write_text("\n".join(["angle, p", *rows]))


@pytest.mark.parametrize("name", PHASES)
def test_each_kind_is_built_and_written_back(name, read, tmp_path):
    kind, numbers = PHASES[name]
    write_table(tmp_path)
    scene_file = read(scene_with(type=name, **numbers))
    phase = build_scene(scene_file).volume.phase
    assert isinstance(phase, kind) and name == phase.NAME
    assert phase.colors == (3 if name == "henyey_greenstein" else 1)
    loaded = tensors_in(loaded_again(scene_file).volume.phase)
    assert all(map(torch.equal, loaded, tensors_in(phase)))


def test_a_table_of_another_scale_is_divided_with_a_warning(load, tmp_path):
    write_table(tmp_path, scale=4)
    with pytest.warns(DataWarning, match=r"table.csv: its mean over the sphere is 4"):
        phase = load(scene_with(type="table", file="table.csv")).volume.phase
    cosine = torch.linspace(-1, 1, 9).double()
    torch.testing.assert_close(phase.value(cosine)[0], 0.75 * (1 + cosine**2), rtol=0, atol=2e-3)


def test_droplets_scatter_as_one_sphere_does_and_forward(load):
    miepython = pytest.importorskip("miepython", reason="needs the extra `mie`")
    droplets = {"refractive_index": 1.33, "effective_radius": 1.0, "effective_variance": 1e-4}
    phase = load(scene_with(type="mie", wavelength=[0.6, 0.5, 0.4], **droplets)).volume.phase
    cosine = np.cos(np.radians(np.array([2.0, 30.0, 60.0, 110.0, 170.0])))
    for color, wavelength in enumerate((0.6, 0.5, 0.4)):
        size = 2 * np.pi / wavelength
        sphere = miepython.i_unpolarized(1.33, size, cosine, norm="4pi")
        ours = phase.value(torch.from_numpy(cosine))[color].numpy()
        np.testing.assert_allclose(ours, sphere, rtol=0.15, atol=0.01)
        *_, mean_cosine = miepython.efficiencies_mx(1.33, size)
        assert float(phase.moments(2)[color, 1]) == pytest.approx(mean_cosine, abs=0.01)


@pytest.mark.parametrize(
    "medium",
    [
        {"g": {"file": "cells.npz"}},
        {"phase": {"type": "henyey_greenstein", "g": {"file": "cells.npz"}}},
        {"phase": {"type": "two_lobe", "g": [0.8, -0.3], "weight": {"file": "cells.npz"}}},
        {"g": {"file": "cells.npz", "name": "weight"}},
    ],
    ids=["short", "long", "weight", "another name"],
)
def test_a_number_of_each_cell_comes_from_a_file_and_is_written_back(medium, read, tmp_path):
    cells = np.linspace(0.2, 0.8, 24, dtype=np.float32).reshape(SHAPE)
    np.savez(tmp_path / "cells.npz", g=cells, weight=cells, bounds=BOUNDS)
    scene_file = read(changed(volume=BARE | medium))
    for scene in (build_scene(scene_file), loaded_again(scene_file)):
        assert scene.volume.phase.cells is not None
        assert np.array_equal(scene.volume.phase.cells[0], cells)


def test_a_number_of_each_cell_is_optimized_from_one(load):
    parameters = {"phase.weight": {"init": 0.4, "field": True}, "phase.g": {}}
    phase = {"type": "two_lobe", "g": [0.8, -0.3], "weight": 0.7}
    starts = load(
        changed(volume=BARE | {"phase": phase}, optimize={"parameters": parameters})
    ).starts
    assert torch.equal(starts["phase.weight"], torch.full(SHAPE, 0.4, dtype=torch.float64))
    assert starts["phase.g"].tolist() == [0.8, -0.3]


DROPLETS = {"type": "mie", "wavelength": 0.67, "refractive_index": 1.33, "effective_variance": 0.1}
WATER = {name: VOLUME[name] for name in ("bounds", "resolution")}
WATER |= {"sigma_t": {"meters": 1000}, "albedo": 1, "phase": DROPLETS}


def test_droplets_differ_from_cell_to_cell(load, tmp_path):
    """Between ends that are exact, moments are those of droplets of each size."""
    pytest.importorskip("miepython")
    radius = np.array([7.0, 9.0, 11.0])
    cells = np.broadcast_to(radius[:, None], SHAPE)
    write_field(tmp_path / "sizes.npz", "effective_radius", cells, BOUNDS)
    sizes = {"file": "sizes.npz"}
    medium = load(changed(volume=WATER | {"density": 0.5, "effective_radius": sizes})).volume
    moments_between = medium.phase.moments(9)[0, :, 0, :, 0]
    torch.testing.assert_close(medium.sigma_s[0, 0, :, 0], 1500 / torch.from_numpy(radius))
    assert not medium.sigma_a.any()
    for place, tolerance in ((0, 1e-12), (1, 4e-3)):
        same = load(
            changed(volume=WATER | {"density": 0.5, "effective_radius": float(radius[place])})
        )
        moments = same.volume.phase.moments(9)[0]
        torch.testing.assert_close(moments, moments_between[:, place], rtol=0, atol=tolerance)
        assert same.volume.sigma_s.item() == pytest.approx(1500 / radius[place])


UNITS = {"density": "g/m3", "effective_radius": "um", "temperature": "K"}


def water_of_file(path, **units):
    """A scene of droplets: density 2 and radius 1 in these units, heat 300, from a netCDF file."""
    netcdf = pytest.importorskip("netCDF4", reason="needs the extra `netcdf`")
    known = {"density": 2.0, "effective_radius": 1.0, "temperature": 300.0}
    with netcdf.Dataset(path, "w") as file:
        for axis, count in zip("zyx", SHAPE, strict=True):
            file.createDimension(axis, count)
        for name, value in known.items():
            file.createVariable(name, "f4", tuple("zyx"))[:] = value
            file.variables[name].units = (UNITS | units)[name]
    return changed(volume=WATER | {name: {"file": path.name} for name in known})


@pytest.mark.parametrize(
    ("units", "expected"),
    [
        ({"density": "g m-3", "effective_radius": "µm", "temperature": "kelvin"}, 3000),
        ({"density": "kg/m^3", "effective_radius": "microns"}, 3e6),
        ({"density": "mg m**-3", "effective_radius": "micrometers"}, 3),
        ({"density": ""}, 3000),
    ],
)
def test_files_of_droplets_are_read_in_their_units(units, expected, load, tmp_path, recwarn):
    """A gram in a cubic meter extinguishes 1500 / radius [micrometers] in a kilometer."""
    pytest.importorskip("miepython")
    medium = load(water_of_file(tmp_path / "les.nc", **units)).volume
    assert (medium.density * medium.sigma_s).amax().item() == pytest.approx(expected)
    warned = [str(warning.message) for warning in recwarn if warning.category is DataWarning]
    assert any("density says no unit; taken in g/m3" in text for text in warned) == (
        units["density"] == ""
    )


def test_a_file_of_droplets_whose_box_is_in_another_unit_is_refused(load, tmp_path):
    text = water_of_file(tmp_path / "les.nc")
    with pytest.importorskip("netCDF4").Dataset(tmp_path / "les.nc", "a") as file:
        for axis, count in zip("zyx", SHAPE, strict=True):
            file.createVariable(axis, "f4", (axis,))[:] = np.arange(count)
            file.variables[axis].units = "m"
    refusal = "volume.sigma_t.meters: is 1000, but u of les.nc has 1 m"
    with pytest.raises(SceneError, match=re.escape(refusal)):
        load(text)


@pytest.mark.parametrize(
    ("name", "unit", "expected"),
    [
        *(("density", unit, "g/m3") for unit in ("kg/kg", "g kg-1", "1", "kg m-2", "m-3")),
        ("effective_radius", "1", "micrometers"),
        ("temperature", "degC", "kelvin"),
    ],
)
def test_files_in_units_of_other_quantities_are_refused(name, unit, expected, load, tmp_path):
    text = water_of_file(tmp_path / "les.nc", **{name: unit})
    with pytest.raises(FormatError, match=f"les.nc: {name} is in {unit}, not {expected}"):
        load(text)


# Two media

CLOUD = {"density": {"file": "cloud.npz"}, "sigma_t": 20, "albedo": 0.9, "g": 0.8}
AIR = {"density": 0.5, "sigma_a": 0, "sigma_s": [0.1, 0.2, 0.4], "phase": {"type": "rayleigh"}}
MEDIA = {"media": {"cloud": CLOUD, "air": AIR}}


@pytest.fixture
def cloud(tmp_path):
    write_field(tmp_path / "cloud.npz", "density", np.linspace(0, 1, 24).reshape(SHAPE), BOUNDS)


@pytest.mark.usefixtures("cloud")
def test_two_media_are_their_mixture_and_are_written_back(read):
    scene_file = read(changed(volume=MEDIA))
    mixture = build_scene(scene_file).volume
    assert mixture.grid.shape == SHAPE and isinstance(mixture.phase, Blend)
    assert isinstance(mixture.phase.second, Rayleigh) and mixture.media is not None
    assert mixture.media["cloud"].g == torch.tensor(0.8)
    expected = mix_media(mixture.media)
    for medium in (mixture, loaded_again(scene_file).volume):
        assert torch.equal(medium.sigma_a, expected.sigma_a)
        assert torch.equal(medium.sigma_s, expected.sigma_s)
        assert all(map(torch.equal, tensors_in(medium.phase), tensors_in(expected.phase)))


@pytest.mark.usefixtures("cloud")
def test_what_is_found_of_a_medium_is_put_into_it(read, tmp_path):
    optimize = {"parameters": {"media.cloud.albedo": {"init": 0.5}, "media.air.sigma_s": {}}}
    text = changed(volume=MEDIA, optimize=optimize)
    scene_file = read(text, "optimize.parameters.media.cloud.g.init=0.3")
    scene = build_scene(scene_file)
    assert scene.starts["media.cloud.g"] == torch.tensor(0.3)
    assert float(scene.starts["media.cloud.albedo"]) == 0.5
    names = result_names(list(scene.starts))
    values = {name: value_of(scene, name).squeeze().tolist() for name in names}
    values |= {"media.cloud.g": 0.4, "media.air.sigma_s": [0.3, 0.2, 0.1]}
    dump_scene(describe_result(scene_file, scene, values), tmp_path / "result.yaml")
    media = load_scene(tmp_path / "result.yaml").volume.media
    assert media is not None and media["cloud"].g == torch.tensor(0.4)
    assert media["air"].sigma_s.tolist() == pytest.approx([0.3, 0.2, 0.1])
    assert float(media["cloud"].sigma_s) == pytest.approx(18)
