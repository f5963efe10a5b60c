"""Runs commands on several ranks, as torchrun does, but forked from one process: quickly.

    python forked.py JOBS FOLDER

JOBS is a JSON list of {"ranks": N, "arguments": [...], "failing": [...]}. What rank
R of job J prints goes to FOLDER/J.R.out and J.R.err; FOLDER/codes.json has the exit codes, job by
job. "failing" [rank, iteration, how] ends a rank before that iteration: "killed", or by an error.
With "seeds": true each rank has its own.
"""

import json
import os
import signal
import socket
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import imageio.plugins.pillow  # noqa: F401
import PIL.Image
import torch
import torch._decomp.decompositions_for_jvp
import torch._dynamo
from zero_tangents import ask_python

# What commands import is imported once, before there are several processes. So is, above, what
# pictures and derivatives in forward mode need.
from ddrecon.cli import main
from ddrecon.errors import FormatError
from ddrecon.reconstruct.loop import Reconstruction

for name in ("cli.session", "run.render_folder", "terms", "uncertainty"):
    import_module(f"ddrecon.{name}")
PIL.Image.init()
ask_python(everything=False)

LOADED = set(sys.modules)


def run_job(job: dict[str, Any], number: int, folder: Path) -> list[int]:
    """The exit codes of the ranks of a job."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    children = []
    for rank in range(job["ranks"]):
        child = os.fork()
        if child == 0:
            for stream, end in ((1, "out"), (2, "err")):
                file = os.open(folder / f"{number}.{rank}.{end}", os.O_CREAT | os.O_WRONLY)
                os.dup2(file, stream)
            os.environ |= {
                "RANK": str(rank),
                "LOCAL_RANK": str(rank),
                "WORLD_SIZE": str(job["ranks"]),
                "MASTER_ADDR": "127.0.0.1",
                "MASTER_PORT": str(port),
                "DDRECON_MEET_SECONDS": "60",
            }
            os._exit(do(job, rank))
        children.append(child)
    return [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]


def do(job: dict[str, Any], rank: int) -> int:
    """The exit code of one rank."""
    if job.get("failing", [None])[0] == rank:
        fail_before(*job["failing"][1:])
    seed = ["--seed", str(rank)] if job.get("seeds") else []
    try:
        main([*job["arguments"], *seed], standalone_mode=False)
        code = 0
    except SystemExit as error:
        code = int(error.code or 0)
    if job["ranks"] == 1:
        new = sorted(name for name in set(sys.modules) - LOADED if "distributed" in name)
        sys.stdout.write(f"{new}\n{torch.distributed.is_initialized()}\n")
    sys.stdout.flush()
    sys.stderr.flush()
    return code


def fail_before(iteration: int, how: str) -> None:
    """Has this process fail before it makes `iteration`."""
    advance = Reconstruction.advance

    def fail(run: Reconstruction) -> Any:
        if run.iteration + 1 == iteration:
            if how == "killed":
                os.kill(os.getpid(), signal.SIGKILL)
            raise FormatError("some.file", how)
        return advance(run)

    Reconstruction.advance = fail  # type: ignore[method-assign]


if __name__ == "__main__":
    jobs, folder = json.loads(sys.argv[1]), Path(sys.argv[2])
    codes = [run_job(job, number, folder) for number, job in enumerate(jobs)]
    (folder / "codes.json").write_text(json.dumps(codes))
