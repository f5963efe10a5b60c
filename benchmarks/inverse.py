"""The inverse problem by defaults alone: how near known volumes come, a row for each scene.

    python benchmarks/inverse.py [-o FOLDER] [--only NAME ...] [--references FOLDER]

Every run is a process of its own, `ddrecon optimize`, of one thread unless OMP_NUM_THREADS says
more. Configs are taken as they are; other scenes say what is known of them and no setting
(`inverse_scenes.py`). Rows `at3d_5` to `at3d_80` are clouds by optical depth beside AT3D, which
reports RRMSE below 20 % and bias 0.1 % below depth 17, and 60 % and -35 % at 80
(doi:10.5194/amt-16-3931-2023).

L1 and RRMSE are sums over all cells, relative to the truth's; mass is the relative error of the
sum. Where emission is sought too, it stands second. Held out is what a run says of itself; anew is
the same of what `ddrecon render` makes of the volume, often in narrower cells. An iteration is what
a row of `loss.csv` is; of the film they are its last frame's. Scenes stay in FOLDER, and are taken
from there the next time.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from figures import as_options, ddrecon, print_header, print_row
from inverse_scenes import BUILDERS, perspective, render_views
from pyshdom import write_scene
from reconstruction import ROOT, coarsened

from ddrecon.io.volumes.table import read_field

FRAME = 2
"""The frame of the film that is compared; frames begin with 0."""
FIELDS = ("density", "emission")
COLUMNS = {
    "l1": "{:.3f}",
    "rrmse": "{:.3f}",
    "mass": "{:+.1%}",
    "held out [dB]": "{:.1f}",
    "anew [dB]": "{:.1f}",
    "iterations": "{:.0f}",
    "seconds": "{:.0f}",
    "of processor": "{:.0f}",
    "memory [MiB]": "{:.0f}",
}
Row = dict[str, list[float]]
"""What the columns hold, by name; of errors one number a field."""


@dataclass(frozen=True)
class Task:
    """The file of a scene, and that of its true fields.

    `frame` is the place of a film's frame in its run; `is_masked` says that cells that are truly
    empty are known to be.
    """

    scene: Path
    truth: Path
    options: tuple[str, ...] = ()
    frame: str = ""
    is_masked: bool = False


CONFIGS = {
    "plume": Task(ROOT / "configs/plume.yaml", ROOT / "data/plume/density.npz"),
    "ball": Task(ROOT / "configs/ball.yaml", ROOT / "data/ball/density.npz"),
    "fire": Task(ROOT / "configs/fire.yaml", ROOT / "data/fire/fire.npz"),
    "capture": Task(ROOT / "configs/capture.yaml", ROOT / "data/capture/density.npz"),
    "film": Task(
        ROOT / "configs/film.yaml",
        ROOT / f"data/film/density_{FRAME:04d}.npz",
        ("--frames", f"0:{FRAME}"),
        f"frames/{FRAME:04d}",
    ),
}
PYSHDOM = {"pyshdom": (), "pyshdom_masked": ("-D", "volume.sigma_t={file: mask.npz}")}
"""Options of its runs."""
REFERENCES = ("views_cloud", *PYSHDOM)
"""Scenes made from a folder of references."""
NAMES = (*CONFIGS, *BUILDERS, *REFERENCES)


def write_views(source: Path, folder: Path) -> Task:
    """The scene of the pictures in `source`, which `views.json` describes."""
    about = json.loads((source / "views.json").read_text())
    truth = read_field(source / "density.npz", "density").values
    sides = np.array(about["extent"]) / 2
    views = []
    for view in about["views"]:
        place, image = view["camera"], str(source / f"{view['name']}.npy")
        look = {key: place[key] for key in ("up", "fov")} | {"resolution": view["resolution"]}
        away = np.subtract(place["origin"], place["target"])
        views.append(perspective(view["name"], place["target"], away, **look) | {"image": image})
    medium = {key: about[key] for key in ("sigma_t", "albedo", "g")}
    box = {"bounds": {"min": (-sides).tolist(), "max": sides.tolist()}}
    cells = {"resolution": truth.shape[::-1], "density": 0}
    lights = [{"type": "directional", **light} for light in about["light"]]
    scene = {"volume": box | cells | medium, "lights": lights, "views": views}
    density = {"init": 0, "min": 0}
    scene["optimize"] = {"iterations": "auto", "parameters": {"density": density}}
    (folder / "scene.yaml").write_text(json.dumps(scene, indent=1))
    return Task(folder / "scene.yaml", source / "density.npz")


def write_pyshdom(copy: Path, folder: Path) -> None:
    """The scene of `pyshdom.py`, without settings of its own."""
    write_scene(copy, folder)
    scene = json.loads((folder / "sought.yaml").read_text())
    density = {"init": 0, "support": "masks"}
    scene["optimize"] = {"iterations": "auto", "parameters": {"density": density}}
    (folder / "scene.yaml").write_text(json.dumps(scene, indent=1))


def prepare(name: str, folder: Path, references: Path | None) -> Task | None:
    """The task `name`, its scene in `folder` unless it is there already; None without its files."""
    if name in CONFIGS:
        return CONFIGS[name]
    scene, source = folder / "scene.yaml", references and references / name.partition("_masked")[0]
    if name in BUILDERS:
        if not scene.exists():
            BUILDERS[name]().write(folder)
        return Task(scene, folder / "truth.npz")
    if source is None or not source.exists():
        return None
    folder.mkdir(parents=True, exist_ok=True)
    if name not in PYSHDOM:
        return write_views(source, folder)
    write_pyshdom(source, folder)
    return Task(scene, folder / "cloud.npz", PYSHDOM[name], is_masked=name == "pyshdom_masked")


def errors_of(task: Task, run: Path) -> Row:
    """L1, RRMSE and mass of each field that was sought, against the truth."""
    row: Row = {"l1": [], "rrmse": [], "mass": []}
    for name in FIELDS:
        if (path := run / "volumes" / f"{name}.npz").exists():
            sought = read_field(path, name).values.astype(np.float64)
            true = read_field(task.truth, name).values.astype(np.float64)
            true = coarsened(true, sought.shape[: true.ndim])
            if sought.ndim > true.ndim:  # colors of a gray truth
                true = np.broadcast_to(true[..., None], sought.shape)
            if task.is_masked:
                sought *= true > 0
            row["l1"].append(float(np.abs(sought - true).sum() / true.sum()))
            row["rrmse"].append(float(np.linalg.norm(sought - true) / np.linalg.norm(true)))
            row["mass"].append(float(sought.sum() / true.sum() - 1))
    return row


def render_anew(scene: Path, run: Path) -> list[float]:
    """The mean PSNR of held-out views of the JSON `scene`, with the volume of `run` put in."""
    known = json.loads(scene.read_text())
    del known["optimize"]
    for path in (run / "volumes").glob("*.npz"):
        known["volume"][path.stem] = {"file": str(path)}
    known["views"] = [view for view in known["views"] if view.get("split") == "test"]
    if not known["views"]:
        return []
    again = scene.with_name("anew.yaml")
    again.write_text(json.dumps(known))
    ratios = []
    for view, image in zip(known["views"], render_views(again), strict=True):
        picture = np.load(scene.parent / view["image"])
        away = image - picture
        ratios.append(10 * np.log10(picture.max() ** 2 / (away**2).mean()))
    return [float(np.mean(ratios))]


def measure(task: Task, run: Path, options: list[str]) -> Row:
    """Reconstructs `task` in the folder `run`; raises SystemExit where that fails."""
    command = ["optimize", task.scene.name, "-o", run, *task.options, *options]
    used = ddrecon(*command, folder=task.scene.parent)
    place = run / task.frame
    summary = json.loads((place / "summary.json").read_text())
    row = errors_of(task, place) | {"iterations": [summary["iterations"]]}
    if summary.get("test_psnr") is not None:
        row["held out [dB]"] = [summary["test_psnr"]]
    if task.scene.parent != ROOT / "configs":
        row["anew [dB]"] = render_anew(task.scene, place)
    return row | {name: [x] for name, x in zip([*COLUMNS][-3:], used, strict=True)}


def main() -> None:
    """Runs the scenes that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, help="of scenes and runs; kept if given")
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=NAMES, default=NAMES)
    parser.add_argument("--references", type=Path, help="has views_cloud/ and a copy of pyshdom/")
    parser.add_argument("-D", dest="keys", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    folder = (given.output or Path(tempfile.mkdtemp())).resolve()
    options = as_options(given.keys)
    print_header("scene", *COLUMNS)
    for name in given.only:
        references = given.references and given.references.resolve()
        task = prepare(name, folder / name, references)
        if task is None:
            print(f"{name}: not among the references", file=sys.stderr)
        else:
            row = measure(task, folder / name / "run", options)
            forms = COLUMNS.items()
            print_row(name, *(", ".join(map(f.format, row.get(column, ()))) for column, f in forms))


if __name__ == "__main__":
    main()
