"""Every figure that README.md and docs/ quote: measures it, and writes it where it stands.

    python benchmarks/figures.py --references FOLDER [NAME]...     all of them, or some

A figure is a table that one command prints. It stands between `<!-- figure: NAME -->` and
`<!-- end of figure -->`, with its command, commit, day and machine: on the page that quotes it, or
in benchmarks/tables.md where it is too long for a page, which then names it. `summary` is the
README's table, of numbers that other figures have. Run it on idle cores. Path tracing needs the
extra `reference` and DRJIT_LIBLLVM_PATH; FOLDER keeps what was traced, and holds
`images/cases.json` of the eleven cases.
"""

from __future__ import annotations

import argparse
import datetime
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
TRACED = "eleven", "derivative", "angles", "volumes", "grounds"
COMMANDS = {
    **{name: f"python benchmarks/accuracy.py {name} --references FOLDER" for name in TRACED},
    "thick": "python benchmarks/accuracy.py thick",
    "layers": "python benchmarks/dial.py",
    "plume": "python benchmarks/reconstruction.py plume",
    "capture": "python benchmarks/reconstruction.py capture",
    "film": "python benchmarks/reconstruction.py film",
    "inverse": "python benchmarks/inverse.py --references FOLDER",
    "replay": "python benchmarks/path_replay.py --paths 4 16",
    "cloud": "python benchmarks/cloud_path_replay.py FOLDER/wdas_cloud_sixteenth.vdb",
    "engines": "python benchmarks/speed.py engines",
    "launches": "python benchmarks/launches.py --as-a-gpu",
    "memory": "python benchmarks/memory.py --cells 96",
    "gpu": "python benchmarks/gpu_check.py speed",
    "scale": "python benchmarks/speed.py scale",
    "speed": "ddrecon bench --quick",
    "hard": "ddrecon bench --hard",
    "gradcheck": "ddrecon gradcheck configs/gradcheck_all.yaml",
    "uncertainty": "python benchmarks/uncertainty.py --references FOLDER",
    "paper": "python benchmarks/paper.py",
    "fig08": "python benchmarks/paper.py fig08",
    "fig13": "python benchmarks/paper.py fig13",
    "pyshdom": "python benchmarks/pyshdom.py FOLDER/pyshdom",
    "mouse": "python benchmarks/mouse.py FOLDER/mouse",
}
"""By the name of a figure, what prints it."""
COPIED = {"pyshdom": "pyshdom", "cloud": "wdas_cloud_sixteenth.vdb", "mouse": "mouse"}
"""Figures of what licenses keep out of here, and its place in FOLDER: measured where it is."""
PLUME = "plume", "as the config has it"
SUMMARY = {
    "images against path tracing, eleven cases: mean error": ("eleven", "mean", "default"),
    "the same, worst": ("eleven", "worst", "default"),
    "the same by diffusion alone (`transport_rounds: 0`): mean error": ("eleven", "mean", "n = 0"),
    "the plume of the two commands: held-out PSNR": (*PLUME, "held out"),
    "relative L1 error of its density": (*PLUME, "L1"),
    "seconds of the whole process": (*PLUME, "seconds"),
    "image of 512 x 512 and its derivative by 64 x 96 x 64 cells: seconds": (
        *("replay", "ours", "both s"),
    ),
    "Mitsuba's path replay with 16 paths a pixel: times as long": (
        *("replay", "Mitsuba, 16 paths a pixel", "times ours"),
    ),
    "a film's cloud from 64 pictures: held-out PSNR": ("cloud", "ours", "held out"),
    "Mitsuba's path replay in the same time, its best rate of three": (
        *("cloud", "path replay, rate 0.003", "held out"),
    ),
}
"""The README's table: what it says, by the figure, row and column that say it."""
PLACE = re.compile(r"(<!-- figure: (\w+) -->\n)(.*?)(<!-- end of figure -->)", re.DOTALL)


class Used(NamedTuple):
    """Seconds of a process, those of processors, and its largest memory [MiB]."""

    seconds: float
    processor: float
    memory: float


def ddrecon(*arguments: str | Path, folder: Path | None = None) -> Used:
    """What a command of ours takes, run in `folder`, over what it left there.

    Raises SystemExit where it fails.
    """
    command = [sys.executable, "-m", "ddrecon", *arguments, "-q", "--overwrite"]
    start = time.perf_counter()
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        words = " ".join(map(str, command))
        raise SystemExit(f"{words}: exit {os.waitstatus_to_exitcode(status)}")
    seconds = time.perf_counter() - start
    return Used(seconds, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


def as_options(overrides: Sequence[str]) -> list[str]:
    """`overrides` as a command takes them."""
    return [word for override in overrides for word in ("-D", override)]


def print_row(*cells: object) -> None:
    """Prints a row of a table."""
    texts = (f"{cell:.3f}" if isinstance(cell, float) else str(cell) for cell in cells)
    print(f"| {' | '.join(texts)} |", flush=True)


def print_header(*names: str) -> None:
    """Prints the head of a table."""
    print_row(*names)
    print_row(*["---"] * len(names))


def pages() -> list[Path]:
    """Where figures may stand."""
    docs = sorted((ROOT / "docs").glob("*.md"))
    return [ROOT / "README.md", *docs, ROOT / "benchmarks/tables.md"]


def read_figures() -> dict[str, str]:
    """What stands on the pages, by the name of its figure."""
    text = "".join(page.read_text() for page in pages())
    return {place[2]: place[3] for place in PLACE.finditer(text)}


def measure(name: str, references: Path) -> None:
    """Runs the command of a figure, and writes the table that it prints where it stands."""
    command = COMMANDS[name]
    words = [word.replace("FOLDER", str(references)) for word in command.split()]
    words[:1] = [sys.executable] if words[0] == "python" else words[:1]
    run = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    lines = [line for line in run.stdout.splitlines() if line.startswith("|")]
    if run.returncode or not lines:
        raise SystemExit(f"{name}: exit {run.returncode}\n{run.stderr[-2000:]}")
    describe = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(describe, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    made = f"`{command}`, commit `{commit.strip()}`, {datetime.date.today().isoformat()}"
    write(name, "\n".join([*lines, "", f"*{made}, {describe_machine()}.*", ""]))


def describe_machine() -> str:
    """The processor, its cores and their load."""
    known = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    name = re.search(r"model name\s*: (.*)", known)
    vectors = ", AVX-512" if "avx512f" in known else ""
    return f"{os.cpu_count()} cores ({name[1].strip() if name else 'unknown'}{vectors})"


def write(name: str, text: str) -> None:
    """Puts the `text` of a figure where it stands."""

    def fill(place: re.Match[str]) -> str:
        return place[1] + text + place[4] if place[2] == name else place[0]

    for page in pages():
        page.write_text(PLACE.sub(fill, page.read_text()))


def show_summary(figures: dict[str, str]) -> str:
    """The table of the README."""
    lines = ["| what | measured | commit |", "|---|---|---|"]
    for what, (name, row, column) in SUMMARY.items():
        commit = re.findall(r"commit `(\w+)`", figures[name])[-1]
        lines.append(f"| {what} | {pick(figures[name], row, column)} | `{commit}` |")
    return "\n".join([*lines, ""])


def pick(figure: str, row: str, column: str) -> str:
    """One cell of a table."""
    heads, *rows = (
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in figure.splitlines()
        if line.startswith("|")
    )
    (cells,) = (cells for cells in rows if cells[0] == row)
    return cells[heads.index(column)]


def main() -> None:
    """Measures what is asked for, and writes it into the pages."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", choices=[[], "summary", *COMMANDS], metavar="NAME")
    parser.add_argument("--references", type=Path, default=Path("references"))
    given = parser.parse_args()
    references = given.references.resolve()
    absent = [name for name, place in COPIED.items() if not (references / place).exists()]
    absent += [] if shutil.which("nvidia-smi") else ["gpu"]
    for name in given.names or [name for name in COMMANDS if name not in absent]:
        print(name, flush=True)
        if name != "summary":
            measure(name, references)
    write("summary", show_summary(read_figures()))


if __name__ == "__main__":
    main()
