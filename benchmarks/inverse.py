"""The inverse problem by defaults alone: how near known volumes come, a row for each scene.

    python benchmarks/inverse.py [-o FOLDER] [--only NAME ...] [--references FOLDER]

Every run is a process of its own, `ddrecon optimize`, of one thread unless OMP_NUM_THREADS says
more. Configs are taken as they are; other scenes say what is known of them and no setting
(`inverse_scenes.py`). Rows `at3d_5` to `at3d_80` are clouds by optical depth beside AT3D, which
reports RRMSE, our L2, below 20 % and bias 0.1 % below depth 17, and 60 % and -35 % at 80
(doi:10.5194/amt-16-3931-2023).

L1 and L2 are sums over all cells, relative to the truth's; mass is the relative error of the sum.
Where emission is sought too, it stands second. Held out is what a run says of itself. An iteration
is what a row of `loss.csv` is; of the film they are its last frame's. Scenes stay in FOLDER, and
are taken from there the next time; before, MiB are those of what makes them, where that is more.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from figures import ROOT, as_options, ddrecon, print_header, print_row
from inverse_scenes import BUILDERS, coarsened, look

from ddrecon.io.volumes.table import read_field

COLUMNS = {
    "L1": "{:.3f}",
    "L2": "{:.3f}",
    "mass": "{:+.1%}",
    "held out": "{:.1f} dB",
    "iterations": "{:.0f}",
    "seconds": "{:.0f}",
    "processor s": "{:.0f}",
    "MiB": "{:.0f}",
}
Row = dict[str, list[float]]
"""What the columns hold, by name; of errors one number a field."""


@dataclass(frozen=True)
class Task:
    """The file of a scene, and that of its true fields.

    `frame` is the place of a film's frame in its run.
    """

    scene: Path
    truth: Path
    options: tuple[str, ...] = ()
    frame: str = ""


def of_config(name: str, truth: str, *options: str, frame: str = "") -> Task:
    """A config, whose true fields a file of data/ has."""
    return Task(ROOT / f"configs/{name}.yaml", ROOT / f"data/{truth}.npz", options, frame)


CONFIGS = {
    "plume": of_config("plume", "plume/density"),
    "ball": of_config("ball", "ball/density"),
    "fire": of_config("fire", "fire/fire"),
    "capture": of_config("capture", "capture/density"),
    "film": of_config("film", "film/density_0002", "--frames", "0:2", frame="frames/0002"),
    "cumulus_field": of_config("cumulus_field", "cumulus_field/density"),
    "satellite": of_config("satellite", "cumulus_field/density"),
}
REFERENCE = "views_cloud"
"""The scene made from a folder of references."""


def write_views(source: Path, folder: Path) -> None:
    """Writes the scene of the pictures in `source`, which `views.json` describes."""
    folder.mkdir(parents=True, exist_ok=True)
    about = json.loads((source / "views.json").read_text())
    cells = read_field(source / "density.npz", "density").values.shape[::-1]
    sides = np.array(about["extent"]) / 2
    views = []
    for view in about["views"]:
        place, image = view["camera"], str(source / f"{view['name']}.npy")
        camera = {key: place[key] for key in ("up", "fov")} | {"resolution": view["resolution"]}
        away = np.subtract(place["origin"], place["target"])
        views.append(look(view["name"], place["target"], away, **camera) | {"image": image})
    medium = {key: about[key] for key in ("sigma_t", "albedo", "g")}
    box = {"bounds": {"min": (-sides).tolist(), "max": sides.tolist()}}
    lights = [{"type": "directional", **light} for light in about["light"]]
    volume = box | {"resolution": cells, "density": 0} | medium
    sought = {"parameters": {"density": {"init": 0, "min": 0}}}
    scene = {"volume": volume, "lights": lights, "views": views, "optimize": sought}
    (folder / "scene.yaml").write_text(json.dumps(scene, indent=1))


def prepare(name: str, folder: Path, references: Path | None) -> Task | None:
    """The task `name`, its scene in `folder` unless it is there already; None without its files."""
    if name in CONFIGS:
        return CONFIGS[name]
    scene, source = folder / "scene.yaml", references and references / name
    if name in BUILDERS:
        if not scene.exists():
            BUILDERS[name]().write(folder)
        return Task(scene, folder / "truth.npz")
    if source is None or not source.exists():
        return None
    write_views(source, folder)
    return Task(scene, source / "density.npz")


def errors_of(truth: Path, run: Path) -> Row:
    """L1, L2 and mass of each field that was sought, against the truth."""
    row: Row = {"L1": [], "L2": [], "mass": []}
    for name in ("density", "emission"):
        if (path := run / "volumes" / f"{name}.npz").exists():
            sought = read_field(path, name).values.astype(np.float64)
            true = read_field(truth, name).values.astype(np.float64)
            true = coarsened(true, sought.shape[: true.ndim])
            if sought.ndim > true.ndim:  # colors of a gray truth
                true = np.broadcast_to(true[..., None], sought.shape)
            row["L1"].append(float(np.abs(sought - true).sum() / true.sum()))
            row["L2"].append(float(np.linalg.norm(sought - true) / np.linalg.norm(true)))
            row["mass"].append(float(sought.sum() / true.sum() - 1))
    return row


def measure(task: Task, run: Path, options: Sequence[str] = ()) -> Row:
    """Reconstructs `task` in the folder `run`; raises SystemExit where that fails."""
    command = ["optimize", task.scene.name, "-o", run, *task.options, *options]
    used = ddrecon(*command, folder=task.scene.parent)
    place = run / task.frame
    summary = json.loads((place / "summary.json").read_text())
    row = errors_of(task.truth, place) | {"iterations": [summary["iterations"]]}
    if summary.get("test_psnr") is not None:
        row["held out"] = [summary["test_psnr"]]
    return row | {name: [number] for name, number in zip([*COLUMNS][-3:], used, strict=True)}


def print_measured(name: str, row: Row, columns: Iterable[str]) -> None:
    """Prints a row of the table."""
    print_row(name, *(", ".join(map(COLUMNS[key].format, row.get(key, ()))) for key in columns))


def main() -> None:
    """Runs the scenes that the command line asks for."""
    names = (*CONFIGS, *BUILDERS, REFERENCE)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, help="of scenes and runs; kept if given")
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=names, default=names)
    parser.add_argument("--references", type=Path, help=f"has {REFERENCE}/")
    parser.add_argument("-D", dest="keys", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    folder = (given.output or Path(tempfile.mkdtemp())).resolve()
    references = given.references and given.references.resolve()
    print_header("scene", *COLUMNS)
    for name in given.only:
        task = prepare(name, folder / name, references)
        if task is None:
            print(f"{name}: not among the references", file=sys.stderr)
        else:
            row = measure(task, folder / name / "run", as_options(given.keys))
            print_measured(name, row, COLUMNS)


if __name__ == "__main__":
    main()
