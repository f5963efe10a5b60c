"""The section volume.phase: what it becomes, what is written back, and what is refused."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from example_scene import SCENE, changed

from ddrecon.errors import DataWarning, FormatError, SceneError
from ddrecon.io.volumes.table import write_field
from ddrecon.medium.coefficients import Volume
from ddrecon.medium.phase import HenyeyGreenstein, Rayleigh
from ddrecon.medium.phase_blend import TwoLobe
from ddrecon.medium.phase_series import Tabulated
from ddrecon.scene_file.build import build_scene, load_scene
from ddrecon.scene_file.load import describe, dump_scene, read_scene

BOUNDS = np.array([[-0.5, -0.75, -0.5], [0.5, 0.75, 0.5]])
VOLUME = {name: value for name, value in yaml.safe_load(SCENE)["volume"].items() if name != "g"}
SECTIONS: dict[str, tuple[type, dict[str, Any]]] = {
    "henyey_greenstein": (HenyeyGreenstein, {"g": [0.8, 0.7, 0.6]}),
    "two_lobe": (TwoLobe, {"g": [0.8, -0.3], "weight": 0.7}),
    "rayleigh": (Rayleigh, {}),
    "table": (Tabulated, {"file": "table.csv"}),
}


def scene_with(**phase: Any) -> str:
    return changed(volume=VOLUME | {"phase": phase}, optimize=None)


@pytest.fixture(autouse=True)
def table(tmp_path: Path) -> None:
    degrees = np.arange(0, 181, 5)
    values = 0.75 * (1 + np.cos(np.radians(degrees)) ** 2)
    rows = [f"{angle}, {value}" for angle, value in zip(degrees, values, strict=True)]
    (tmp_path / "table.csv").write_text("\n".join(["angle, p", *rows]))


@pytest.mark.parametrize("name", SECTIONS)
def test_each_kind_is_built_and_written_back(
    name: str, write: Callable[[str], Path], tmp_path: Path
) -> None:
    kind, numbers = SECTIONS[name]
    scene_file = read_scene(write(scene_with(type=name, **numbers)))
    scene = build_scene(scene_file)
    phase = scene.volume.phase
    assert isinstance(phase, kind) and name == phase.NAME
    assert phase.colors == (3 if name == "henyey_greenstein" else 1)
    assert scene.volume.sigma_s.shape[0] == 3
    dump_scene(describe(scene_file), tmp_path / "again.yaml")
    again = load_scene(tmp_path / "again.yaml").volume.phase
    assert all(map(torch.equal, again.numbers, phase.numbers))


def test_a_table_of_another_scale_is_divided_with_a_warning(
    write: Callable[[str], Path], tmp_path: Path
) -> None:
    known = load_scene(write(scene_with(type="table", file="table.csv"))).volume.phase
    lines = (tmp_path / "table.csv").read_text().splitlines()
    rows = [line.split(", ") for line in lines[1:]]
    scaled = [f"{angle}, {4 * float(value)}" for angle, value in rows]
    (tmp_path / "table.csv").write_text("\n".join([lines[0], *scaled]))
    with pytest.warns(DataWarning, match=r"table.csv: its mean over the sphere is 4"):
        phase = load_scene(write(scene_with(type="table", file="table.csv"))).volume.phase
    cosine = torch.linspace(-1, 1, 9)
    torch.testing.assert_close(phase.value(cosine), known.value(cosine))
    exact = 0.75 * (1 + cosine**2)
    torch.testing.assert_close(phase.value(cosine)[0], exact, rtol=0, atol=2e-3)


def test_droplets_scatter_as_one_sphere_does_and_forward(write: Callable[[str], Path]) -> None:
    miepython = pytest.importorskip("miepython", reason="needs the extra `mie`")
    phase = {"refractive_index": 1.33, "effective_radius": 1.0, "effective_variance": 1e-4}
    text = scene_with(type="mie", wavelength=[0.6, 0.5, 0.4], **phase)
    phase = load_scene(write(text), dtype=torch.float64).volume.phase
    cosine = np.cos(np.radians(np.array([2.0, 30.0, 60.0, 110.0, 170.0])))
    for color, wavelength in enumerate((0.6, 0.5, 0.4)):
        size = 2 * np.pi / wavelength
        one = miepython.i_unpolarized(1.33, size, cosine, norm="4pi")
        ours = phase.value(torch.from_numpy(cosine))[color].numpy()
        np.testing.assert_allclose(ours, one, rtol=0.15, atol=0.01)
        *_, mean_cosine = miepython.efficiencies_mx(1.33, size)
        assert float(phase.moments(2)[color, 1]) == pytest.approx(mean_cosine, abs=0.01)


CELLS = (6, 5, 4)
"""In x, y, z."""


def write_cells(path: Path, **fields: float) -> None:
    """Fields of one number, but for the first cell, which has half of it."""
    arrays = {name: np.full(CELLS[::-1], value, np.float32) for name, value in fields.items()}
    for array in arrays.values():
        array[0, 0, 0] /= 2
    bounds = np.array([[0, 0, 0], CELLS], np.float32)
    np.savez(path, bounds=bounds, **arrays)  # type: ignore[arg-type]


def cells_scene(**volume: Any) -> str:
    sizes = {"bounds": {"min": [0, 0, 0], "max": list(CELLS)}, "resolution": list(CELLS)}
    fixed = {"density": 0.1, "sigma_t": 5, "albedo": 0.9}
    return changed(volume=sizes | fixed | volume, optimize=None)


@pytest.mark.parametrize(
    "volume",
    [
        {"g": {"file": "cells.npz"}},
        {"phase": {"type": "henyey_greenstein", "g": {"file": "cells.npz"}}},
        {"phase": {"type": "two_lobe", "g": [0.8, -0.3], "weight": {"file": "cells.npz"}}},
        {"g": {"file": "cells.npz", "name": "weight"}},
    ],
    ids=["short", "long", "weight", "another name"],
)
def test_a_number_of_each_cell_comes_from_a_file_and_is_written_back(
    volume: dict[str, Any], write: Callable[[str], Path], tmp_path: Path
) -> None:
    write_cells(tmp_path / "cells.npz", g=0.6, weight=0.6)
    scene_file = read_scene(write(cells_scene(**volume)))
    cells = build_scene(scene_file).volume.phase.cells
    assert cells is not None and cells.shape == (1, *CELLS[::-1])
    assert float(cells[0, 0, 0, 0]) == pytest.approx(0.3)
    assert bool((cells.flatten()[1:] - 0.6).abs().max() < 1e-6)
    dump_scene(describe(scene_file), tmp_path / "again.yaml")
    again = load_scene(tmp_path / "again.yaml").volume.phase.cells
    assert again is not None and torch.equal(again, cells)


def test_a_number_of_each_cell_is_optimized_from_one(write: Callable[[str], Path]) -> None:
    parameters = {"phase.weight": {"init": 0.4, "field": True}, "phase.g": {}}
    phase = {"type": "two_lobe", "g": [0.8, -0.3], "weight": 0.7}
    text = changed(volume=VOLUME | {"phase": phase}, optimize={"parameters": parameters})
    scene = load_scene(write(text))
    weight = scene.starts["phase.weight"]
    assert weight.shape == scene.volume.grid.shape and bool((weight == 0.4).all())
    assert scene.starts["phase.g"].tolist() == pytest.approx([0.8, -0.3])


def test_droplets_differ_from_cell_to_cell(write: Callable[[str], Path], tmp_path: Path) -> None:
    """Between ends that are exact, moments are those of droplets of each size."""
    pytest.importorskip("miepython")
    droplets = {"type": "mie", "wavelength": 0.67, "refractive_index": 1.33}
    droplets |= {"effective_variance": 0.1}
    radius = np.array([7.0, 9.0, 11.0])
    cells = np.broadcast_to(radius[:, None], (4, 3, 2))
    write_field(tmp_path / "sizes.npz", "effective_radius", cells, BOUNDS)
    water = {name: VOLUME[name] for name in ("bounds", "resolution")}
    water |= {"density": 0.5, "sigma_t": {"meters": 1000}, "albedo": 1}

    def built(radius: Any) -> Volume:
        volume = water | {"phase": droplets, "effective_radius": radius}
        return load_scene(write(changed(volume=volume)), dtype=torch.float64).volume

    medium = built({"file": "sizes.npz"})
    moments_between = medium.phase.moments(9)[0, :, 0, :, 0]
    torch.testing.assert_close(medium.sigma_s[0, 0, :, 0], 1500 / torch.from_numpy(radius))
    assert not medium.sigma_a.any()
    for place, tolerance in ((0, 1e-12), (1, 4e-3)):
        same = built(float(radius[place]))
        moments = same.phase.moments(9)[0]
        torch.testing.assert_close(moments, moments_between[:, place], rtol=0, atol=tolerance)
        assert same.sigma_s.item() == pytest.approx(1500 / float(radius[place]))


UNITS = {"density": "g/m3", "effective_radius": "um", "temperature": "K"}


def water_of_file(path: Path, **units: str) -> str:
    """A scene of droplets: density 2 and radius 1 in these units, heat 300, from a netCDF file."""
    netcdf = pytest.importorskip("netCDF4", reason="needs the extra `netcdf`")
    known = {"density": 2.0, "effective_radius": 1.0, "temperature": 300.0}
    with netcdf.Dataset(path, "w") as file:
        for axis, count in zip("zyx", (4, 3, 2), strict=True):
            file.createDimension(axis, count)
        for name, value in known.items():
            file.createVariable(name, "f4", tuple("zyx"))[:] = value
            file.variables[name].units = (UNITS | units)[name]
    volume = {name: VOLUME[name] for name in ("bounds", "resolution")}
    volume |= {"sigma_t": {"meters": 1000}, "albedo": 1} | {n: {"file": path.name} for n in known}
    droplets = {"type": "mie", "wavelength": 0.67, "refractive_index": 1.33}
    return changed(volume=volume | {"phase": droplets | {"effective_variance": 0.1}})


@pytest.mark.parametrize(
    ("units", "expected"),
    [
        ({}, 3000),
        ({"density": "g m-3", "effective_radius": "µm", "temperature": "kelvin"}, 3000),
        ({"density": "kg/m^3", "effective_radius": "microns"}, 3e6),
        ({"density": "mg m**-3", "effective_radius": "micrometers"}, 3),
    ],
)
def test_files_of_droplets_are_read_in_their_units(
    units: dict[str, str], expected: float, write: Callable[[str], Path], tmp_path: Path
) -> None:
    """A gram in a cubic meter extinguishes 1500 / radius [micrometers] in a kilometer."""
    pytest.importorskip("miepython")
    text = water_of_file(tmp_path / "les.nc", **units)
    medium = load_scene(write(text)).volume
    assert (medium.density * medium.sigma_s).amax().item() == pytest.approx(expected)


def test_a_unit_that_a_file_does_not_say_is_taken_with_a_warning(
    write: Callable[[str], Path], tmp_path: Path
) -> None:
    pytest.importorskip("miepython")
    with pytest.warns(DataWarning, match="les.nc: density says no unit; taken in g/m3"):
        load_scene(write(water_of_file(tmp_path / "les.nc", density="")))


def test_a_file_of_droplets_whose_box_is_in_another_unit_is_refused(
    write: Callable[[str], Path], tmp_path: Path
) -> None:
    text = water_of_file(tmp_path / "les.nc")
    with pytest.importorskip("netCDF4").Dataset(tmp_path / "les.nc", "a") as file:
        for axis, count in zip("zyx", (4, 3, 2), strict=True):
            file.createVariable(axis, "f4", (axis,))[:] = np.arange(count)
            file.variables[axis].units = "m"
    told = "volume.sigma_t.meters: is 1000, but u of les.nc has 1 m"
    with pytest.raises(SceneError, match=re.escape(told)):
        load_scene(write(text))


@pytest.mark.parametrize(
    ("name", "unit", "expected"),
    [
        *(("density", unit, "g/m3") for unit in ("kg/kg", "g kg-1", "1", "kg m-2", "m-3")),
        ("effective_radius", "1", "micrometers"),
        ("temperature", "degC", "kelvin"),
    ],
)
def test_files_in_units_of_other_quantities_are_refused(
    name: str, unit: str, expected: str, write: Callable[[str], Path], tmp_path: Path
) -> None:
    text = water_of_file(tmp_path / "les.nc", **{name: unit})
    with pytest.raises(FormatError, match=f"les.nc: {name} is in {unit}, not {expected}"):
        load_scene(write(text))
