"""Runs that are killed, interrupted or out of space at random, until they are done all the same.

    python fault_runs.py FOLDER SIGNALS SHORTAGES

One process imports torch and forks a child for every fault. Prints as JSON what happened.
"""

import json
import os
import random
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from functools import partial
from io import StringIO
from pathlib import Path

import torch
from small_scene import write_scene

from ddrecon.cli.commands import main
from ddrecon.run import job

SIGNALS = [signal.SIGKILL, signal.SIGTERM, signal.SIGKILL, signal.SIGINT]
NUMBERS = ["-D", "optimize.parameters.g={init: 0.1}", "--iterations", "6"]
NUMBERS += ["-D", "optimize.parameters.views.front.camera={}"]
TOO_EARLY = "\nAborted!\n"
"""What click says of an interrupt before the command has begun."""
EXPECTED = {signal.SIGKILL: -signal.SIGKILL, signal.SIGTERM: 130, signal.SIGINT: 130}


def start(folder: Path, out: Path, prepare: Callable[[], None]) -> int:
    """A child that begins the run in `out`, or goes on with it; its stderr goes to a file."""
    asked = {signal.SIGINT, signal.SIGTERM}
    signal.pthread_sigmask(signal.SIG_BLOCK, asked)  # until the child can say what became of it
    pid = os.fork()
    if pid:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, asked)
        return pid
    try:
        with (folder / "stderr").open("w") as stderr:
            os.dup2(stderr.fileno(), 2)
            os.dup2(stderr.fileno(), 1)
        for number in asked:
            signal.signal(number, signal.default_int_handler)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, asked)
        prepare()
        optimize(folder, out)
    except KeyboardInterrupt:
        sys.stderr.write(TOO_EARLY)
    except SystemExit as end:
        os._exit(end.code if isinstance(end.code, int) else 0)
    except BaseException:  # a child must never return into its parent's code
        traceback.print_exc()
    sys.stderr.flush()
    os._exit(99)


def optimize(folder: Path, out: Path) -> None:
    """The command that a user gives, at first and again."""
    is_begun = (out / "checkpoints/last.pt").is_file()
    going_on = ["--resume"] if is_begun else ["--overwrite"]
    scene, how = str(folder / "scene.yaml"), ["-q", "--preview-every", "4"]
    main(["optimize", scene, *how, "-o", str(out), *going_on, *NUMBERS])


def ended(pid: int) -> int:
    """The exit code of the child, or the negative of the signal it died of."""
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def result_of(out: Path) -> dict[str, object]:
    """What a run has come to, but for the seconds it took: parameters, log, volumes, pictures."""
    rows = [line.split(",") for line in (out / "loss.csv").read_text().splitlines()]
    seconds = rows[0].index("seconds")
    log = [row[:seconds] + row[seconds + 1 :] for row in rows]
    files = [*sorted(out.glob("previews/*")), out / "parameters.json"]
    search = torch.load(out / "checkpoints" / "last.pt", weights_only=True)["state"]["search"]
    tensors = [
        search["values"],
        search["direction"],
        *(x for pair in search["pairs"] for x in pair),
    ]
    return {
        "log": log,
        "files": {path.name: path.read_bytes() for path in files},
        "tensors": [tensor.tolist() for tensor in tensors],
    }


def nothing() -> None:
    """No preparation."""


def kill(folder: Path, count: int, whole: dict[str, object], duration: float) -> dict[str, object]:
    """Runs that receive `count` signals, each within a quarter of the time a whole run takes."""
    faults, wrong, finished, number = 0, list[str](), 0, 0
    out = folder / "out_0"
    while faults < count or not finished:
        pid = start(folder, out, nothing)
        sent = None
        if faults < count:
            time.sleep(random.uniform(0, duration / 4))
            sent = SIGNALS[faults % len(SIGNALS)]
            os.kill(pid, sent)
        code = ended(pid)
        if code == 0:
            finished += 1
            wrong += [f"run {number} differs"] * (result_of(out) != whole)
            number += 1
            out = folder / f"out_{number}"
            continue
        faults += 1
        is_too_early = (folder / "stderr").read_text() == TOO_EARLY
        if sent is None or (code != EXPECTED[sent] and not is_too_early):
            wrong.append(f"{sent}: {code}: {(folder / 'stderr').read_text()}")
    return {"faults": faults, "finished": finished, "wrong": wrong}


def fill(folder: Path, count: int, whole: dict[str, object]) -> dict[str, object]:
    """A run whose files cannot grow beyond a random size, `count` times, and then can."""
    out, wrong, faults = folder / "full", list[str](), 0
    largest = (folder / "whole" / "checkpoints" / "last.pt").stat().st_size
    for _ in range(count):
        most = int(random.uniform(0.02, 1.0) * largest)
        limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (most, most))
        code = ended(start(folder, out, limit))
        lines = (folder / "stderr").read_text().splitlines()
        faults += code == 3
        is_told = code == 3 and "cannot be written: File too large" in lines[-1]
        if code != 0 and not (is_told and len(lines) <= 2):
            wrong.append(f"at most {most} bytes: {code}: {lines}")
    if code := ended(start(folder, out, nothing)):
        wrong.append(f"with space again: {code}: {(folder / 'stderr').read_text()}")
    elif result_of(out) != whole:
        wrong.append("differs")
    return {"faults": faults, "wrong": wrong}


def run(folder: Path, signals: int, shortages: int) -> None:
    torch.set_num_threads(1)
    random.seed(0)
    job.CHECKPOINT_SECONDS, job.CHECKPOINT_SHARE = 0.0, 1e9
    write_scene(folder)
    # Here, so that what is imported on the way is imported once.
    with suppress(SystemExit), redirect_stdout(StringIO()):
        optimize(folder, folder / "whole")
    begin = time.monotonic()
    ended(start(folder, folder / "again", nothing))
    duration, whole = time.monotonic() - begin, result_of(folder / "whole")
    reports = kill(folder, signals, whole, duration), fill(folder, shortages, whole)
    sys.stdout.write(json.dumps(reports))


if __name__ == "__main__":
    run(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
