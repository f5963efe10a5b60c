"""Every figure that README.md and docs/ quote: measures it, and writes it where it is quoted.

    python benchmarks/figures.py --references FOLDER [NAME]...     all of them, or some
    python benchmarks/figures.py --write                           no measuring: pages anew
    python benchmarks/figures.py --show NAME                       prints what is stored

A figure is a table that one command prints. What was measured lies in benchmarks/figures.json with
its commit, day and machine. A page quotes it between `<!-- figure: NAME -->` and
`<!-- end of figure -->`, or names it; a house test compares. Run it on idle cores. Path tracing
needs the extra `reference` and DRJIT_LIBLLVM_PATH; FOLDER keeps what was traced, and holds
`images/cases.json` of the eleven cases.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
STORE = Path(__file__).with_suffix(".json")
COMMANDS = {
    "eleven": "python benchmarks/accuracy.py eleven --references FOLDER",
    "angles": "python benchmarks/accuracy.py angles --references FOLDER",
    "volumes": "python benchmarks/accuracy.py volumes --references FOLDER",
    "grounds": "python benchmarks/accuracy.py grounds --references FOLDER",
    "thick": "python benchmarks/accuracy.py thick",
    "layers": "python benchmarks/dial.py",
    "derivative": "python benchmarks/accuracy.py derivative --references FOLDER",
    "plume": "python benchmarks/reconstruction.py plume",
    "gallery": "python benchmarks/reconstruction.py gallery",
    "capture": "python benchmarks/reconstruction.py capture",
    "film": "python benchmarks/reconstruction.py film",
    "replay": "python benchmarks/path_replay.py --paths 4 16",
    "cloud": "python benchmarks/cloud_path_replay.py FOLDER/wdas_cloud_sixteenth.vdb",
    "engines": "python benchmarks/speed.py engines",
    "tangents": "python benchmarks/speed.py tangents",
    "launches": "python benchmarks/launches.py --as-a-gpu --engines warp",
    "memory": "python benchmarks/memory.py --cells 96",
    "numbers": "python benchmarks/memory.py --count",
    "gpu": "python benchmarks/gpu_check.py speed",
    "scale": "python benchmarks/speed.py scale",
    "speed": "ddrecon bench --quick",
    "hard": "ddrecon bench --hard",
    "gradcheck": "ddrecon gradcheck configs/gradcheck_all.yaml",
    "uncertainty": "python benchmarks/uncertainty.py --references FOLDER",
    "paper": "python benchmarks/paper.py",
    "pyshdom": "python benchmarks/pyshdom.py FOLDER/pyshdom",
    "mouse": "python benchmarks/mouse.py FOLDER/mouse",
}
"""By the name of a figure, what prints it."""
KEPT_BY_THEMSELVES = ("paper",)
"""Scripts that keep their tables."""
COPIED = {"pyshdom": "pyshdom", "cloud": "wdas_cloud_sixteenth.vdb", "mouse": "mouse"}
"""Figures of what licenses keep out of here, and its place in FOLDER: measured where it is."""
SUMMARY = (
    ("images against path tracing, eleven cases: mean error", "eleven", "mean", "default"),
    ("the same, worst", "eleven", "worst", "default"),
    ("the same by diffusion alone (`transport_rounds: 0`): mean error", "eleven", "mean", "n = 0"),
    ("the plume of the two commands: held-out PSNR", "plume", "as the config has it", "held out"),
    ("relative L1 error of its density", "plume", "as the config has it", "L1"),
    ("seconds of the whole process", "plume", "as the config has it", "seconds"),
    (
        "image of 512 x 512 and its derivative by 64 x 96 x 64 cells: seconds",
        "replay",
        "ours",
        "both s",
    ),
    (
        "Mitsuba's path replay with 16 paths a pixel: times as long",
        "replay",
        "Mitsuba, 16 paths a pixel",
        "times ours",
    ),
    ("a film's cloud from 64 pictures: held-out PSNR", "cloud", "ours", "held out"),
    (
        "Mitsuba's path replay in the same time, its best rate of three",
        "cloud",
        "path replay, rate 0.003",
        "held out",
    ),
)
"""The README's table: what it says, and the figure, row and column that say it."""
PLACE = re.compile(r"(<!-- figure: (\w+) -->\n).*?(<!-- end of figure -->)", re.DOTALL)


class Used(NamedTuple):
    """Seconds of a process, those of processors, and its largest memory [MiB]."""

    seconds: float
    processor: float
    memory: float


def run(command: Sequence[str | Path], folder: Path | None = None) -> Used:
    """What `command` takes, run in `folder`; raises SystemExit where it fails."""
    start = time.perf_counter()
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    if status:
        words = " ".join(map(str, command))
        raise SystemExit(f"{words}: exit {os.waitstatus_to_exitcode(status)}")
    return Used(seconds, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


def ddrecon(*arguments: str | Path, folder: Path | None = None) -> Used:
    """What a command of ours takes, run in `folder`, over what it left there."""
    return run([sys.executable, "-m", "ddrecon", *arguments, "-q", "--overwrite"], folder)


def as_options(overrides: Sequence[str]) -> list[str]:
    """`overrides` as a command takes them."""
    return [word for override in overrides for word in ("-D", override)]


def read_store() -> dict[str, Any]:
    """What was measured, by the name of its figure."""
    return json.loads(STORE.read_text()) if STORE.exists() else {}


def describe_machine() -> str:
    """The processor, its cores and their load."""
    known = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    name = re.search(r"model name\s*: (.*)", known)
    vectors = ", AVX-512" if "avx512f" in known else ""
    return f"{os.cpu_count()} cores ({name[1].strip() if name else 'unknown'}{vectors})"


def measure(name: str, references: Path) -> None:
    """Runs the command of a figure, and keeps the table that it prints."""
    command = COMMANDS[name]
    words = [word.replace("FOLDER", str(references)) for word in command.split()]
    words[:1] = [sys.executable] if words[0] == "python" else words[:1]
    run = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    lines = [line for line in run.stdout.splitlines() if line.startswith("|")]
    if run.returncode or not lines:
        raise SystemExit(f"{name}: exit {run.returncode}\n{run.stderr[-2000:]}")
    if name not in KEPT_BY_THEMSELVES:
        keep(name, command, lines)


def keep(name: str, command: str, lines: list[str]) -> None:
    """Stores a table with what made it, where and when, and writes it into the pages."""
    figure = {
        "command": command,
        "commit": ask_git("rev-parse", "--short", "HEAD"),
        "day": datetime.date.today().isoformat(),
        "machine": describe_machine(),
        "table": lines,
    }
    STORE.write_text(json.dumps(read_store() | {name: figure}, indent=1) + "\n")
    write_pages()


def ask_git(*words: str) -> str:
    return subprocess.run(
        ["git", *words], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()


def print_row(*cells: object) -> None:
    """Prints a row of a table."""
    texts = (f"{cell:.3f}" if isinstance(cell, float) else str(cell) for cell in cells)
    print(f"| {' | '.join(texts)} |", flush=True)


def print_header(*names: str) -> None:
    """Prints the head of a table."""
    print_row(*names)
    print_row(*["---"] * len(names))


def split_row(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def pick(figure: dict[str, Any], row: str, column: str) -> str:
    """One cell of a table."""
    heads = split_row(figure["table"][0])
    (found,) = (split_row(line) for line in figure["table"] if split_row(line)[0] == row)
    return found[heads.index(column)]


def show_summary(store: dict[str, Any]) -> str:
    """The table of the README."""
    rows = [
        (text, store[name], pick(store[name], row, column))
        for text, name, row, column in SUMMARY
        if name in store
    ]
    lines = [f"| {text} | {value} | `{figure['commit']}` |" for text, figure, value in rows]
    return "\n".join(["| what | measured | commit |", "|---|---|---|", *lines, ""])


def show(name: str, store: dict[str, Any]) -> str:
    """What stands on a page for a figure: its table, then what made it."""
    if name == "summary":
        return show_summary(store)
    if name not in store:
        return "*Not measured yet with today's code.*\n"
    figure = store[name]
    made = f"`{figure['command']}`, commit `{figure['commit']}`, {figure['day']}"
    return "\n".join([*figure["table"], "", f"*{made}, {figure['machine']}.*", ""])


def pages() -> list[Path]:
    """Where figures may be quoted."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def rewrite(text: str, store: dict[str, Any]) -> str:
    """A page with the figures as they were measured."""
    return PLACE.sub(lambda found: found[1] + show(found[2], store) + found[3], text)


def write_pages() -> None:
    """Puts the stored figures into the pages that quote them."""
    store = read_store()
    for page in pages():
        page.write_text(rewrite(page.read_text(), store))


def main() -> None:
    """Measures what is asked for, and writes it into the pages."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", choices=[[], *COMMANDS], metavar="NAME")
    parser.add_argument("--references", type=Path, default=Path("references"))
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--show", choices=sorted({*COMMANDS, *read_store()}))
    given = parser.parse_args()
    if given.show:
        print(show(given.show, read_store()))
        return
    references = given.references.resolve()
    absent = [name for name, place in COPIED.items() if not (references / place).exists()]
    absent += [] if shutil.which("nvidia-smi") else ["gpu"]
    chosen = given.names or [name for name in COMMANDS if name not in absent]
    for name in [] if given.write else chosen:
        print(name, flush=True)
        measure(name, references)
    write_pages()


if __name__ == "__main__":
    main()
