"""What it brings to share the views of a run over ranks: measured parts, and what follows for GPUs.

    python benchmarks/ranks.py [--largest 64]

The parts of an iteration are seconds of one thread's processor time: what every rank does (light,
its adjoint, the step) and what a view adds, on the plume of `ddrecon.bench.plume` in RGB. All grow
with the cells, where pictures have two pixels a cell. The bytes that an iteration exchanges are
counted. The table of GPUs is computed from these: a GPU is taken to be faster than this thread as
its memory is, and exchanges to run at the published speed of a link. That is kind to the GPU and
hard on sharing.

What two processes bring on this machine: torchrun --nproc-per-node 2 -m ddrecon bench SCENE.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace

import torch
from scaling import start_run, with_colors, with_views
from torch import Tensor

from ddrecon.bench.plume import plume_scene
from ddrecon.memory import Needs, memory_of
from ddrecon.reconstruct import gradients

SIZES = (24, 32, 48, 64)
PIXELS = 2
"""Pixels a cell, along each side: what a view can tell of so many."""
GPU_MEMORY = 3.35e12
"""Bytes a second of an H100's memory (NVIDIA's data sheet, SXM),"""
GPU_ROOM = 80e9
"""and how many there are."""
LINKS = {1: float("inf"), 8: 450e9, 64: 50e9}
"""Bytes a second one way, by ranks: NVLink 4 inside a machine, InfiniBand NDR between machines."""


def parts_of(cells: int, rounds: int = 1) -> tuple[float, float, int, int]:
    """Seconds of an iteration without views, and of a view; cells; bytes that are exchanged.

    With so many transport `rounds`.
    """
    times, sent = [], [0]

    def count(found: Sequence[Tensor | None], _: object) -> list[Tensor | None]:
        sent.append(sum(one.nbytes for one in found if one is not None))
        return list(found)

    gradients.sum_found = count
    for views in (1, 5):
        scene = plume_scene(cells, PIXELS * cells, torch.float32, torch.device("cpu"))
        scene = replace(scene, diffusion=replace(scene.diffusion, transport_rounds=rounds))
        run, taken = start_run(with_views(with_colors(scene, 3), views)), []
        for _ in range(5):
            start = time.process_time()
            run.step()
            taken.append(time.process_time() - start)
        times.append(min(taken[1:]))
    view = (times[1] - times[0]) / 4
    return times[0] - view, view, run.problem.scene.volume.grid.cells, sent[-1]


def memory_speed() -> float:
    """Bytes a second that this thread reads and writes."""
    array, best = torch.rand(2**25), float("inf")
    other = torch.empty_like(array)
    for _ in range(5):
        start = time.process_time()
        other.copy_(array)
        best = min(best, time.process_time() - start)
    return 2 * array.nbytes / best


def main() -> None:
    """Prints what was measured, and what follows."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--largest", type=int, default=max(SIZES))
    sizes = [size for size in SIZES if size <= parser.parse_args().largest]
    torch.set_num_threads(1)
    print("| cells | without views [s] | a view [s] | exchanged [MB] | a cell [B] |")
    print("|---|---|---|---|---|")
    rows = []
    for size in sizes:
        rows.append(parts_of(size))
        fixed, view, cells, exchanged = rows[-1]
        print(
            f"| {size} x {size * 3 // 2} x {size} | {fixed:.3f} | {view:.3f}"
            f" | {exchanged / 1e6:.2f} | {exchanged / cells:.0f} |",
            flush=True,
        )
    # All grow with the cells, but for what small sizes cost besides.
    fixed, view, cells, exchanged = (sum(column) for column in zip(*rows[-2:], strict=True))
    by_cell, of_view, sent = fixed / cells, view / cells, exchanged / cells
    speed = memory_speed()
    print(f"\nThis thread's memory: {speed / 1e9:.1f} GB/s; a GPU counts as", end=" ")
    print(f"{GPU_MEMORY / speed:.0f} of it\n")
    print("| cells | fits into one | views | 1 GPU [s] | 8 GPUs [s] | 64 GPUs [s] |")
    print("|---|---|---|---|---|---|")
    for side in (256, 512, 1024):
        room = memory_of(Needs((side,) * 3, 3, 4, 0, has_rounds=True, varied=1.0))
        fits = "yes" if room < GPU_ROOM else f"no: {room / 1e9:.0f} GB"
        for views in (10, 50, 200):
            shown = []
            for ranks, link in LINKS.items():
                own = -(-views // ranks)
                worked = (by_cell + own * of_view) * side**3 * speed / GPU_MEMORY
                # A ring hands on each byte twice, but for a rank's part (Patarasuk, Yuan 2009).
                exchange = 2 * (ranks - 1) / ranks * sent * side**3 / link
                shown.append((worked + exchange, exchange))
            cells = [
                f"{seconds:.2f} ({shown[0][0] / seconds:.1f} times, exchange {part:.2f})"
                for seconds, part in shown[1:]
            ]
            print(f"| {side}^3 | {fits} | {views} | {shown[0][0]:.2f} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
