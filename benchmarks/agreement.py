"""Whether runs of several processes are the run of one: all losses, and fields at the end.

    python benchmarks/agreement.py plume|many -o runs/agree [--cells 96] [--ranks 2 4] [--killed]

`plume` is configs/plume.yaml, `many` seeks density, sigma_a and sigma_s per cell and color of a
cloud whose pictures are rendered first. Both run coarse to fine. With --killed a process of a
further run is killed half-way, and as many as were tried last go on with --resume.
"""

from __future__ import annotations

import argparse
import csv
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

PLUME = Path(__file__).parents[1] / "configs" / "plume.yaml"
CLOSE = 1e-4
"""What a run of several processes should differ by at most."""
MANY = """\
volume:
  bounds: {{min: [-0.5, -0.5, -0.5], max: [0.5, 0.5, 0.5]}}
  resolution: [{cells}, {cells}, {cells}]
  density: {{file: cloud.npz}}
  sigma_a: [0.5, 1, 2]
  sigma_s: [9, 8, 6]
lights:
  - {{type: directional, direction: [-1, -2, -1], irradiance: 3}}
diffusion: {{transport_rounds: 0}}
optimize:
  parameters:
    density: {{init: 0.3}}
    sigma_a: {{init: 0.5, field: true}}
    sigma_s: {{init: 5, field: true}}
views:
  ring: {{count: 4, radius: 3, height: 0.4, target: [0, 0, 0], fov: 24, resolution: [48, 48]}}
"""


def start(ranks: int, *arguments: str) -> list[subprocess.Popen[str]]:
    """The processes of a command, as torchrun starts them."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    place = {"WORLD_SIZE": str(ranks), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    command = [sys.executable, "-m", "ddrecon", *arguments, "-q", "--threads", "1"]
    return [
        subprocess.Popen(
            command,
            env=os.environ | place | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(ranks)
    ]


def run(ranks: int, *arguments: str) -> float:
    """Seconds that a command of so many processes takes."""
    begun, processes = time.perf_counter(), start(ranks, *arguments)
    for process in processes:
        _, told = process.communicate()
        if process.returncode:
            sys.exit(told)
    return time.perf_counter() - begun


def losses(folder: Path) -> np.ndarray:
    """The loss of each iteration of the run in `folder`."""
    with (folder / "loss.csv").open() as stream:
        return np.array([float(row["loss"]) for row in csv.DictReader(stream)])


def compare(folder: Path, other: Path) -> str:
    """How far the run in `folder` is from the `other`, in the largest values."""
    found, expected = losses(folder), losses(other)
    told = [f"losses {np.abs(found / expected - 1).max():.0e}"]
    for path in sorted((other / "volumes").glob("*.npz")):
        one, two = (np.load(at / "volumes" / path.name)[path.stem] for at in (folder, other))
        far = np.abs(one - two) / np.abs(two).max()
        rms, count = np.sqrt((far**2).mean()), (far > CLOSE).sum()
        told.append(f"{path.stem} {rms:.0e} (worst {far.max():.0e}, {count} above {CLOSE:g})")
    return ", ".join(told)


def write_many(folder: Path, cells: int) -> Path:
    """The scene of many numbers in `folder`, with its pictures."""
    z, y, x = np.meshgrid(*[(np.arange(cells) + 0.5) / cells - 0.5] * 3, indexing="ij")
    density = sum(
        np.exp(-((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2) / 0.02)
        for a, b, c in ((0, 0, 0), (0.2, 0.1, -0.1), (-0.15, -0.2, 0.1))
    )
    box = [[-0.5, -0.5, -0.5], [0.5, 0.5, 0.5]]
    np.savez(folder / "cloud.npz", density=density.astype("f4"), bounds=np.array(box))
    scene, text = folder / "scene.yaml", MANY.format(cells=cells)
    scene.write_text(text)
    run(1, "render", str(scene), "-o", str(folder / "pictures"))
    scene.write_text(f"{text}  images: pictures/*.npy\n")
    return scene


def go_on(folder: Path, command: Sequence[str], ranks: Sequence[int], half: int) -> None:
    """Has the last of a few processes killed in iteration `half`, and more go on.

    `ranks` are the numbers of both; the `command` of the run lacks where it goes.
    """
    few, many = ranks[0], ranks[-1]
    torn = [*command, "-o", str(folder / "torn")]
    processes = start(few, *torn, "--preview-every", str(half))
    # Pictures of that iteration say that it was made.
    while not any((folder / "torn").glob(f"previews/*.{half:06d}.png")):
        time.sleep(0.05)
    processes[-1].send_signal(signal.SIGKILL)
    told = [process.communicate()[1] for process in processes]
    print(f"{few}, the last killed: {told[0].splitlines()[-1]}", flush=True)
    run(many, *torn, "--resume")
    print(f"gone on by {many}: {compare(folder / 'torn', folder / 'one')}", flush=True)


def main() -> None:
    """Prints a line a run."""
    parser = argparse.ArgumentParser()
    parser.add_argument("scene", choices=("plume", "many"))
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--cells", type=int, default=96)
    parser.add_argument("--iterations", type=int, default=30)
    parser.add_argument("--ranks", type=int, nargs="+", default=[2, 4])
    parser.add_argument("--share", choices=("views", "cells"), default="views")
    parser.add_argument("--killed", action="store_true")
    parser.add_argument("-D", dest="overrides", action="append", default=[])
    options = parser.parse_args()
    folder, cells, command = options.output, options.cells, ["optimize"]
    folder.mkdir(parents=True)
    if options.scene == "plume":
        grid = f"volume.resolution=[{cells}, {cells * 3 // 2}, {cells}]"
        command += [str(PLUME), "-D", grid]
    else:
        command += [str(write_many(folder, cells))]
    command += ["--iterations", str(options.iterations)]
    command += [text for override in options.overrides for text in ("-D", override)]
    # Slabs have torch's operations alone; one process then has the same.
    alone, shared = command, command
    if options.share == "cells":
        alone, shared = [*command, "--engine", "torch"], [*command, "--share", "cells"]
    print(f"1: {run(1, *alone, '-o', str(folder / 'one')):.0f} s", flush=True)
    for ranks in options.ranks:
        taken = run(ranks, *shared, "-o", str(folder / str(ranks)))
        print(f"{ranks}: {taken:.0f} s; {compare(folder / str(ranks), folder / 'one')}", flush=True)
    if options.killed:
        go_on(folder, shared, options.ranks, options.iterations // 2)


if __name__ == "__main__":
    main()
