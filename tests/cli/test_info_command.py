"""What `ddrecon info` says of volumes and images."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from click.testing import Result

from ddrecon.io.volumes.table import field_names, write_field

Run = Callable[..., Result]
Refuse = Callable[..., list[str]]
BOUNDS = np.array([[-1.0, -2.0, -3.0], [1.0, 1.0, 1.0]])


def colored() -> np.ndarray:
    values = np.zeros((2, 3, 4, 3))
    values[0, 0] = [0.5, 1.0, 0.0]
    return values


def test_a_volume(succeed: Run, suffix: str) -> None:
    write_field(Path(f"smoke.albedo{suffix}"), "albedo", colored(), BOUNDS)
    cells, albedo, *more = succeed("info", f"smoke.albedo{suffix}").stdout.splitlines()
    box = "from [-1.0, -2.0, -3.0] to [1.0, 1.0, 1.0]"
    assert cells == f"cells: 4 x 3 x 2 (x, y, z) of 0.5 x 1 x 2 u, {box}"
    assert albedo == "albedo: RGB, 0 to 1, mean 0.08333, more than 0.0001 of the largest in 16.7 %"
    assert not more


def test_what_is_no_field_of_the_same_cells_is_named(succeed: Run, refuse: Refuse) -> None:
    """And left out of an export, with a warning; a file of nothing else is refused."""
    others = {"origin": np.zeros(3), "finer": np.ones((4, 4, 4))}
    np.savez("all.npz", density=np.ones((2, 2, 2)), bounds=BOUNDS, **others)
    cells, density, *told = succeed("info", "all.npz").stdout.splitlines()
    assert cells.startswith("cells: 2 x 2 x 2") and density.startswith("density: gray, 1 to 1")
    starts = [
        f"no field: {name} {why}"
        for name, why in zip(others, ("has shape [3]", "has 4 x 4"), strict=True)
    ]
    assert all(line.startswith(start) for line, start in zip(told, starts, strict=True))
    said = json.loads(succeed("info", "all.npz", "--json").stdout)
    assert list(said["fields"]) == ["density"] and list(said["no_fields"]) == list(others)
    result = succeed("export", "all.npz", "-o", "out.vdb")
    assert [line.split()[4] for line in result.stderr.splitlines()] == list(others)
    assert field_names(Path("out.vdb")) == ["density"]
    np.savez("none.npz", origin=others["origin"])
    assert "origin has shape [3]" in refuse(3, "info", "none.npz")[-1]


def test_a_haze_counts_as_empty(succeed: Run) -> None:
    """Of less than a ten thousandth of the largest, as an optimization leaves it."""
    haze = np.geomspace(1e-19, 0.9e-4, 24).reshape(2, 3, 4)
    haze[0, 0, :2] = 1, 1.1e-4
    write_field(Path("smoke.npz"), "density", 7 * haze, BOUNDS)
    assert "more than 0.0001 of the largest in 8.33 %" in succeed("info", "smoke.npz").stdout


def test_the_volume_of_a_scene(succeed: Run) -> None:
    """Its fields as their file has them, and what is the same everywhere."""
    override = ["-D", "volume.density={file: density.npz}"]
    report = json.loads(succeed("info", "density.npz", "--json").stdout)
    field = report["fields"]["density"]
    assert report["resolution"] == [6, 5, 4] and field["colors"] == field["filled"] == 1
    assert 0 < field["min"] < field["mean"] < field["max"] < 1
    told = succeed("info", "scene.yaml", *override).stdout.splitlines()
    assert told[:2] == succeed("info", "density.npz").stdout.splitlines()
    assert [line.split(":")[0] for line in told[2:]] == ["sigma_t", "albedo", "g"]
    assert all(line.endswith(" everywhere") for line in told[2:])


def test_an_image(succeed: Run) -> None:
    np.save("picture.npy", np.concatenate([np.full((4, 5, 3), 2.0), np.zeros((4, 5, 3))]))
    told = "image: 5 x 8 pixels, gray, linear radiance 0 to 2, mean 1, not 0 in 50 %\n"
    assert succeed("info", "picture.npy").stdout == told
