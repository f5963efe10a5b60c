"""A run of many iterations of a tiny scene, in a process of its own: do its memory, its files or the time of an iteration grow?

    OMP_NUM_THREADS=1 python benchmarks/long_run.py [--iterations 20000] [--folder FOLDER]

Prints, for each tenth of the run, the median resident size, the median time of an iteration, and the bytes of all files but the log.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
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
  - {name: front, image: front.npy, camera: {type: perspective, origin: [0, 0, 2.5], target: [0, 0, 0], fov: 30, resolution: [8, 6]}}
  - {name: side, image: side.npy, camera: {type: perspective, origin: [2.5, 0, 0], target: [0, 0, 0], fov: 30, resolution: [8, 6]}}
  - {name: test, image: side.npy, split: test,
     camera: {type: perspective, origin: [-2.5, 0, 0], target: [0, 0, 0], fov: 30, resolution: [8, 6]}}
optimize:
  views_per_iteration: 1
  parameters: {density: {init: 0.5, lr: 0.01}}
"""
COMMAND = "from ddrecon.cli import main; main()"


def prepare(folder: Path) -> Path:
    """Writes the scene and its pictures; returns the scene's path."""
    y, x = np.mgrid[-1:1:6j, -1:1:8j]
    for name, width in (("front", 1.0), ("side", 0.7)):
        np.save(folder / f"{name}.npy", (np.maximum(0.5 - x**2 / width - y**2, 0)[..., None] * np.ones(3)).astype(np.float32))
    path = folder / "scene.yaml"
    path.write_text(SCENE)
    return path


def resident(pid: int) -> int:
    """Bytes that process `pid` has in memory."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096


def written(folder: Path) -> int:
    """Bytes of all files below `folder` but the log, and but temporary ones."""
    names = [path for path in folder.rglob("*") if path.is_file() and path.name != "loss.csv" and ".partial-" not in path.name]
    return sum(path.stat().st_size for path in names)


def watch(process: subprocess.Popen[bytes], out: Path) -> list[tuple[int, int, int]]:
    """(iterations made, resident bytes, written bytes), about four times a second, until `process` ends."""
    samples, made, position, log = [], -1, 0, out / "loss.csv"
    while process.poll() is None:
        time.sleep(0.25)
        if log.exists():
            with log.open("rb") as stream:
                stream.seek(position)
                made += stream.read().count(b"\n")
                position = stream.tell()
            try:
                samples.append((made, resident(process.pid), written(out)))
            except (OSError, IndexError):
                continue
    return samples


def tenths(samples: list[tuple[int, int, int]], seconds: list[float], iterations: int) -> list[dict[str, float]]:
    """What each tenth of the run had: MiB, milliseconds an iteration, KiB on the disk."""
    rows = []
    for tenth in range(10):
        low, high = tenth * iterations // 10, (tenth + 1) * iterations // 10
        inside = [sample for sample in samples if low <= sample[0] < high]
        steps = [later - earlier for earlier, later in zip(seconds[low:high], seconds[low + 1 : high], strict=False)]
        memory, files = median(sample[1] for sample in inside), median(sample[2] for sample in inside)
        rows.append({"MiB": memory / 2**20, "ms": 1000 * median(steps), "KiB": files / 2**10})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=20_000)
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    folder = given.folder or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    scene, out = prepare(folder), folder / "out"
    arguments = ["optimize", str(scene), "-q", "-o", str(out), "--iterations", str(given.iterations)]
    process = subprocess.Popen([sys.executable, "-c", COMMAND, *arguments])
    samples = watch(process, out)
    seconds = [float(line.split(",")[1]) for line in (out / "loss.csv").read_text().splitlines()[1:]]
    rows = tenths(samples, seconds, given.iterations)
    for number, row in enumerate(rows, 1):
        print(f"tenth {number}: {row['MiB']:.1f} MiB, {row['ms']:.2f} ms an iteration, {row['KiB']:.0f} KiB of files")
    print(f"memory, last tenth over second: {rows[-1]['MiB'] / rows[1]['MiB']:.4f}; time: {rows[-1]['ms'] / rows[1]['ms']:.3f}")
    print(json.dumps({"exit": process.returncode, "iterations": len(seconds), "tenths": rows}))


if __name__ == "__main__":
    main()
