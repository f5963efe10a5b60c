"""A run of many iterations of a tiny scene, in a process of its own: do its memory, its files or
the time of an iteration grow?

    OMP_NUM_THREADS=1 python benchmarks/long_run.py [--iterations 20000] [--folder FOLDER]

Prints, for each tenth of the run, the median resident size, the processor time of an iteration
(which the load of the machine does not change much, as it does the clock's), and the bytes of all
files but the log.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np

SCENE = """\
volume:
  bounds: {min: [-0.5, -0.5, -0.5], max: [0.5, 0.5, 0.5]}
  resolution: [6, 5, 4]
  density: 0
  sigma_a: 0.5
  sigma_s: 6
  g: 0.3
lights:
  - {type: directional, direction: [-1, -2, -1], irradiance: 3}
views:
  - {name: front, image: front.npy,
     camera: {type: perspective, origin: [0, 0, 2.5], target: [0, 0, 0],
              fov: 30, resolution: [8, 6]}}
  - {name: side, image: side.npy,
     camera: {type: perspective, origin: [2.5, 0, 0], target: [0, 0, 0],
              fov: 30, resolution: [8, 6]}}
  - {name: test, image: side.npy, split: test,
     camera: {type: perspective, origin: [-2.5, 0, 0], target: [0, 0, 0],
              fov: 30, resolution: [8, 6]}}
optimize:
  views_per_iteration: 1
  parameters: {density: {init: 0.5, lr: 0.01}}
"""
COMMAND = "from ddrecon.cli import main; main()"


def prepare(folder: Path) -> Path:
    """Writes the scene and its pictures; returns the scene's path."""
    y, x = np.mgrid[-1:1:6j, -1:1:8j]
    for name, width in (("front", 1.0), ("side", 0.7)):
        np.save(
            folder / f"{name}.npy",
            (np.maximum(0.5 - x**2 / width - y**2, 0)[..., None] * np.ones(3)).astype(np.float32),
        )
    path = folder / "scene.yaml"
    path.write_text(SCENE)
    return path


@dataclass(frozen=True)
class Sample:
    """What the run has come to at a moment: iterations made, bytes in memory, processor seconds
    used, bytes on the disk.
    """

    made: int
    resident: int
    seconds: float
    written: int


def sample(pid: int, made: int, out: Path) -> Sample:
    """A sample of process `pid`, that writes to `out`."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    numbers = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    seconds = (int(numbers[11]) + int(numbers[12])) / os.sysconf("SC_CLK_TCK")
    return Sample(made, pages * os.sysconf("SC_PAGE_SIZE"), seconds, count_bytes(out))


def count_bytes(folder: Path) -> int:
    """Bytes of all files below `folder` but the log, and but temporary ones."""
    names = [
        path
        for path in folder.rglob("*")
        if path.is_file() and path.name != "loss.csv" and ".partial-" not in path.name
    ]
    return sum(path.stat().st_size for path in names)


def watch(process: subprocess.Popen[bytes], out: Path) -> list[Sample]:
    """Samples about four times a second, until `process` ends."""
    samples, made, position, log = [], -1, 0, out / "loss.csv"
    while process.poll() is None:
        time.sleep(0.25)
        if log.exists():
            with log.open("rb") as stream:
                stream.seek(position)
                made += stream.read().count(b"\n")
                position = stream.tell()
            with suppress(OSError, IndexError):
                samples.append(sample(process.pid, made, out))
    return samples


def tenths(samples: list[Sample], iterations: int) -> list[dict[str, float]]:
    """What each tenth of the run had: MiB, milliseconds of processor time an iteration, KiB on the
    disk.
    """
    rows = []
    for tenth in range(10):
        inside = [
            each
            for each in samples
            if tenth * iterations // 10 <= each.made < (tenth + 1) * iterations // 10
        ]
        first, last = inside[0], inside[-1]
        memory, files = (
            median(each.resident for each in inside),
            median(each.written for each in inside),
        )
        milliseconds = 1000 * (last.seconds - first.seconds) / (last.made - first.made)
        rows.append({"MiB": memory / 2**20, "ms": milliseconds, "KiB": files / 2**10})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--iterations", type=int, default=20_000)
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    folder = given.folder or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    scene, out = prepare(folder), folder / "out"
    arguments = [
        "optimize",
        str(scene),
        "-q",
        "-o",
        str(out),
        "--iterations",
        str(given.iterations),
    ]
    process = subprocess.Popen([sys.executable, "-c", COMMAND, *arguments])
    samples = watch(process, out)
    rows = tenths(samples, given.iterations)
    for number, row in enumerate(rows, 1):
        print(
            f"tenth {number}: {row['MiB']:.1f} MiB, {row['ms']:.2f} ms an iteration, "
            f"{row['KiB']:.0f} KiB of files"
        )
    print(
        f"memory, last tenth over second: {rows[-1]['MiB'] / rows[1]['MiB']:.4f}; time: "
        f"{rows[-1]['ms'] / rows[1]['ms']:.3f}"
    )
    print(json.dumps({"exit": process.returncode, "tenths": rows}))


if __name__ == "__main__":
    main()
