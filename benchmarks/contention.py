"""How evenly iterations go while another program takes one of the processor's cores.

    python benchmarks/contention.py [--iterations 100] [--factor 2] [--rounds 1]

Prints a table in Markdown: an engine a row, alone and beside a process that computes without end,
with threads that wait as OpenMP's default has it and as the command line sets it. An iteration is
one of `configs/plume.yaml` with `factor` (1, 2 or 4) times fewer cells and pixels along each side.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from statistics import median
from time import perf_counter

from ddrecon.cli.command import THREADING
from ddrecon.engine import ENGINES

SCENE = Path(__file__).parents[1] / "configs" / "plume.yaml"
BUSY = "while True: pass"
WARM_UP = 15
"""Iterations before those that are measured; the first have next to nothing to render."""
MEASURE = "--measure"


def measure(engine: str, iterations: int, factor: int, rounds: int) -> list[float]:
    """The time [s] of each iteration, in this process."""
    import torch

    from ddrecon.engine import use_engine
    from ddrecon.reconstruct.loop import Reconstruction
    from ddrecon.scene_file.build import load_scene

    use_engine(engine)
    torch.set_num_threads(os.cpu_count() or 1)
    torch.manual_seed(0)
    scene = load_scene(SCENE, overrides=[f"diffusion.transport_rounds={rounds}"])
    assert scene.optimize is not None
    # Refined when all is over, so many times as make the first level so coarse.
    settings = replace(scene.optimize, refine_at=(1.0,) * (factor.bit_length() - 1))
    run = Reconstruction(replace(scene, optimize=settings), WARM_UP + iterations)
    seconds = []
    while not run.is_done:
        start = perf_counter()
        run.step()
        seconds.append(perf_counter() - start)
    return seconds[WARM_UP:]


def measure_apart(arguments: list[str], environment: dict[str, str], is_crowded: bool) -> list:
    """The same of a process of its own, beside a busy one where it `is_crowded`."""
    busy = subprocess.Popen([sys.executable, "-c", BUSY]) if is_crowded else None
    try:
        command = [sys.executable, __file__, *arguments]
        text = subprocess.run(
            command, env=environment, check=True, stdout=subprocess.PIPE, text=True
        ).stdout
    finally:
        if busy is not None:
            busy.kill()
            busy.wait()
    return [float(word) for word in text.split()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--factor", type=int, default=2, choices=(1, 2, 4))
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--engines", nargs="+", default=list(ENGINES), choices=ENGINES)
    parser.add_argument(MEASURE, metavar="ENGINE", choices=ENGINES)
    asked = parser.parse_args()
    common = asked.iterations, asked.factor, asked.rounds
    if asked.measure:
        print(*measure(asked.measure, *common))
        return
    print("| engine | beside | waiting threads | median [s] | worst [s] | worst / median |")
    print("|---|---|---|---|---|---|")
    plain = {name: value for name, value in os.environ.items() if name not in THREADING}
    ways = {"spin": plain, "spin, then sleep": plain | THREADING}
    numbers = [f"--{name}={getattr(asked, name)}" for name in ("iterations", "factor", "rounds")]
    for engine in asked.engines:
        for is_crowded in (False, True):
            for way, environment in ways.items():
                arguments = [MEASURE, engine, *numbers]
                seconds = measure_apart(arguments, environment, is_crowded)
                usual, worst = median(seconds), max(seconds)
                beside = "a busy process" if is_crowded else "nothing"
                times = f"{usual:.3f} | {worst:.3f} | {worst / usual:.1f}"
                print(f"| {engine} | {beside} | {way} | {times} |", flush=True)


if __name__ == "__main__":
    main()
