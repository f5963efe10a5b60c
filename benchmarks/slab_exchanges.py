"""What an iteration in slabs exchanges, counted, and what that makes of 8 and 64 GPUs.

    python benchmarks/slab_exchanges.py

Every exchange of an iteration of small runs is counted by what it is for. How its bytes grow with a
face of the grid, with colors, cycles, pixels and ranks is fitted to runs that differ in these. The
table of GPUs adds the parts of an iteration that `benchmarks/ranks.py` measures.
"""

from __future__ import annotations

import json
import math
import os
import socket
import sys
from collections import defaultdict
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from types import FrameType
from typing import Any

import numpy as np
import torch
from ranks import GPU_MEMORY, GPU_ROOM, LINKS, PIXELS, memory_speed, parts_of
from scaling import start_run, with_colors, with_views

import ddrecon.ranks
from ddrecon.bench.plume import plume_scene
from ddrecon.diffusion.closures import coarse_grid
from ddrecon.engine import use_engine
from ddrecon.grid import Grid
from ddrecon.memory import Needs, memory_of
from ddrecon.reconstruct import loop
from ddrecon.slabs.slab import HALO, THINNEST

FEW, NUMBERS = 256, "numbers"
"""Exchanges of no more bytes are of single numbers: what they cost is being called."""
CALL = 2e-5
"""Seconds that an exchange takes at least, for each doubling of the ranks; assumed."""
CYCLES = 6
"""Cycles of multigrid of an iteration in the table, forward and adjoint together."""
PARAMETERS = 20
"""Bytes a cell that parameters take, whole on every rank, where density is sought."""


@dataclass(frozen=True)
class Case:
    """A run on n x 1.5 n x n cells, or of another `length` over n, in slabs across that axis.

    Light is solved for to `tolerance`, in so many `cycles`, forward and adjoint together.
    """

    n: int
    colors: int
    views: int
    ranks: int
    tolerance: float = 1e-3
    cycles: int = 0
    length: float = 1.5

    @property
    def distances(self) -> float:
        """Cells of the coarse grid of distances, if they were as thin as those of the grid."""
        length = int(self.length * self.n)
        grid = Grid.from_xyz((self.n, length, self.n), (0, 0, 0), (1, 1, 1))
        return coarse_grid(grid).shape[0] ** 2 * length

    @property
    def cells(self) -> float:
        """How many cells there are."""
        return self.length * self.n**3

    @property
    def face(self) -> int:
        """Cells of a layer across the long axis."""
        return self.n**2

    @property
    def rays(self) -> int:
        """Pixels of all views."""
        return self.views * (PIXELS * self.n) ** 2


SWAP, GATHER, SUM = "swap_with_neighbors", "gather_from_ranks", "sum_over_ranks"
TRADE = "trade_with_ranks"
"""Exchanges: with neighbors; of a part that each has; of sums that all get; of a part for each."""
Grown = dict[str, Callable[[Case], float]]
LAWS: dict[tuple[str, str], Grown] = {
    (SWAP, "the solver"): {
        "face x colors x cycles": lambda c: c.face * c.colors * c.cycles,
        "face x colors": lambda c: c.face * c.colors,
    },
    (SWAP, "light"): {"face": lambda c: c.face, "face x colors": lambda c: c.face * c.colors},
    (GATHER, "the solver"): {
        "cells x colors x cycles / ranks": lambda c: c.cells * c.colors * c.cycles / c.ranks,
        "cells x colors / ranks": lambda c: c.cells * c.colors / c.ranks,
    },
    (GATHER, "light"): {
        "face": lambda c: c.face,
        "distances x colors / ranks": lambda c: c.distances * c.colors / c.ranks,
    },
    (SUM, "light"): {
        "face x ranks": lambda c: c.face * c.ranks,
        "distances x colors": lambda c: c.distances * c.colors,
    },
    (TRADE, "views"): {"pixels": lambda c: c.rays},
    (SUM, "views"): {
        "pixels": lambda c: c.rays,
        "pixels x colors": lambda c: c.rays * c.colors,
    },
    (SUM, "derivatives"): {"cells": lambda c: c.cells},
}
"""What the bytes of each exchange grow with, by what it is for."""
CASES = (
    Case(16, 3, 2, 2),
    Case(24, 3, 2, 2, 1e-6),
    Case(24, 1, 2, 3),
    Case(24, 3, 1, 3, 1e-6),
    Case(32, 3, 1, 4),
)
PURPOSES = {
    "Ghosts.fill": "the solver",
    "Ghosts.gather": "the solver",
    "_differentiate_views": "views",
    "sum_found": "derivatives",
    "differentiate": "light",
}
"""What an exchange is for, by the first function that is found on the way to it."""


def purpose_of(frame: FrameType | None) -> str:
    """What the exchange is for that is made in `frame`."""
    while frame is not None:
        code = frame.f_code
        for name in (code.co_qualname, code.co_name):
            if name in PURPOSES:
                return PURPOSES[name]
        frame = frame.f_back
    return NUMBERS


def iterate(case: Case) -> dict[str, Any]:
    """Bytes and calls of the second iteration, on this rank, by kind of exchange and purpose."""
    scene = plume_scene(case.n, PIXELS * case.n, torch.float32, torch.device("cpu"))
    settings = replace(scene.diffusion, transport_rounds=0, tolerance=case.tolerance)
    scene = replace(scene, diffusion=settings)
    run = start_run(with_views(with_colors(scene, case.colors), case.views))
    ddrecon.ranks.join_ranks(has_gpu=False, has_slabs=True)
    # To the scene's own tolerance, so that cases differ in cycles.
    loop.solve_tolerances = lambda _: {}
    run.step()
    found: dict[str, list[int]] = defaultdict(lambda: [0, 0])
    exchange = ddrecon.ranks._exchange

    def counted(count: int) -> AbstractContextManager[None]:
        frame = sys._getframe(1)
        name = frame.f_code.co_name
        is_large = name in (SWAP, GATHER, SUM, TRADE) and count > FEW
        entry = found[f"{name}|{purpose_of(frame) if is_large else NUMBERS}"]
        entry[0] += count
        entry[1] += 1
        return exchange(count)

    ddrecon.ranks._exchange = counted
    row = run.step()
    return {"found": found, "cycles": row.forward_iterations + row.adjoint_iterations}


def count(case: Case) -> tuple[Case, dict[str, list[int]]]:
    """`case` with its cycles, and what its second rank exchanges in an iteration."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    reading, writing = os.pipe()
    children = []
    for rank in range(case.ranks):
        child = os.fork()
        if child == 0:
            place = {"RANK": rank, "WORLD_SIZE": case.ranks, "MASTER_PORT": port}
            os.environ |= {key: str(value) for key, value in place.items()}
            os.environ["MASTER_ADDR"] = "127.0.0.1"
            told = json.dumps(iterate(case))
            if rank == 1:
                os.write(writing, told.encode())
            os._exit(0)
        children.append(child)
    for child in children:
        os.waitpid(child, 0)
    told = json.loads(os.read(reading, 2**16))
    return replace(case, cycles=told["cycles"]), told["found"]


@dataclass(frozen=True)
class Law:
    """Bytes that a rank hands to exchanges of one kind, for one purpose, and how often it does.

    `factors` are bytes a unit of what they grow with; `error` is that of the fit. `calls` are how
    many there are a cycle, a view, and once.
    """

    kind: str
    purpose: str
    factors: tuple[float, ...]
    error: float
    calls: tuple[float, ...]

    def seconds(self, case: Case, link: float) -> float:
        """How long they take in `case` by links of so many bytes a second."""
        grown = LAWS.get((self.kind, self.purpose), {}).values()
        part = sum(f * law(case) for f, law in zip(self.factors, grown, strict=True))
        # Neighbors swap at the same time; a ring hands on all parts, or each sum twice.
        others = case.ranks - 1
        often = {SWAP: 1.0, GATHER: others, SUM: 2 * others / case.ranks}
        calls = sum(a * b for a, b in zip(self.calls, (case.cycles, case.views, 1), strict=True))
        steps = 1 if self.kind == SWAP else math.log2(case.ranks)
        return often.get(self.kind, 1.0) * part / link + calls * CALL * steps


def fit(counted: list[tuple[Case, dict[str, list[int]]]]) -> list[Law]:
    """The laws of all exchanges that were counted."""
    laws = []
    for key in sorted({key for _, found in counted for key in found}):
        kind, purpose = key.split("|")
        # The middle ranks' swaps are with both neighbors; of two ranks each has one.
        sides = [2 if kind == SWAP and case.ranks == 2 else 1 for case, _ in counted]
        bytes_, calls = (
            np.array([found.get(key, [0, 0])[i] for _, found in counted], float) for i in (0, 1)
        )
        bytes_ *= sides
        steps = np.array([[case.cycles, case.views, 1.0] for case, _ in counted])
        often = np.linalg.lstsq(steps, calls, rcond=None)[0]
        factors, error = np.zeros(0), 0.0
        if law_of := LAWS.get((kind, purpose)):
            matrix = np.array([[law(case) for law in law_of.values()] for case, _ in counted])
            scale = 1 / np.maximum(bytes_, 1)[:, None]
            factors = np.linalg.lstsq(matrix * scale, bytes_ * scale[:, 0], rcond=None)[0]
            error = float(np.abs((matrix @ factors) * scale[:, 0] - 1).max())
        laws.append(Law(kind, purpose, tuple(factors), error, tuple(often)))
    return laws


def print_laws(laws: list[Law]) -> None:
    """Prints what was fitted."""
    print("| exchange | for | bytes | calls | fit |\n|---|---|---|---|---|")
    for law in laws:
        grown = LAWS.get((law.kind, law.purpose), {})
        shown = " + ".join(f"{f:.3g} x {name}" for f, name in zip(law.factors, grown, strict=True))
        calls = "{:.1f} a cycle + {:.1f} a view + {:.1f}".format(*law.calls)
        print(f"| {law.kind} | {law.purpose} | {shown} | {calls} | {100 * law.error:.0f} % |")


@dataclass(frozen=True)
class Parts:
    """Seconds of a GPU: `light` of a cell, and `look` of a cell for each view; `sent` bytes a cell.

    The last are those that ranks exchange who share views.
    """

    light: float
    look: float
    sent: float

    def of_shared_views(self, side: int, views: int, ranks: int, link: float) -> float:
        """Seconds of an iteration of side^3 cells, where each rank has some of the views."""
        ring = 2 * (ranks - 1) / ranks * self.sent / link
        return (self.light + -(-views // ranks) * self.look + ring) * side**3

    def of_slabs(self, side: int, views: int, thickness: float) -> float:
        """The same without exchanges, where each rank has a slab of so many layers.

        It computes its halo as well; grids from the second on, a seventh of all, are everybody's.
        """
        coarse = self.light / 7
        own = self.light - coarse + views * self.look
        return (own * part_of(side, thickness) + coarse) * side**3


def part_of(side: int, thickness: float) -> float:
    """The part of all cells that a slab has with its halo."""
    return min(1.0, (thickness + 2 * HALO) / side)


def print_table(laws: list[Law], parts: Parts) -> None:
    """Prints what is computed for GPUs."""
    print("| cells | views | GPUs | views shared [s] | cells shared [s] | exchanged | GB each |")
    print("|---|---|---|---|---|---|---|")
    for side in (256, 512, 1024):
        room = memory_of(Needs((side,) * 3, 3, 4, 0, has_rounds=False, varied=1.0))
        whole = PARAMETERS * side**3
        for views in (10, 50, 200):
            for ranks, link in LINKS.items():
                shared = parts.of_shared_views(side, views, ranks, link)
                told, thickness = f"{side}^3 | {views} | {ranks} | {shared:.2f}", side / ranks
                if ranks == 1:
                    print(f"| {told} | | | {room / 1e9:.0f} |")
                elif thickness < THINNEST:
                    print(f"| {told} | too thin | | |")
                else:
                    case = Case(side, 3, views, ranks, cycles=CYCLES, length=1.0)
                    exchanges = sum(law.seconds(case, link) for law in laws)
                    seconds = parts.of_slabs(side, views, thickness) + exchanges
                    each = (room - whole) * part_of(side, thickness) + whole
                    note = "" if each < GPU_ROOM else ", too much"
                    print(f"| {told} | {seconds:.2f} | {exchanges:.2f} | {each / 1e9:.0f}{note} |")


def main() -> None:
    """Prints what was counted and fitted, and the table of GPUs."""
    torch.set_num_threads(1)
    use_engine("torch")
    laws = fit([count(case) for case in CASES])
    print_laws(laws)
    use_engine("auto")
    rows = [parts_of(size, rounds=0) for size in (48, 64)]
    light, look, cells, sent = (sum(column) for column in zip(*rows, strict=True))
    faster = GPU_MEMORY / memory_speed()
    print(f"\nOn this thread a cell takes {1e9 * light / cells:.0f} ns of light", end=" ")
    print(f"and {1e9 * look / cells:.0f} a view; a GPU counts as {faster:.0f} threads\n")
    print_table(laws, Parts(light / cells / faster, look / cells / faster, sent / cells))


if __name__ == "__main__":
    main()
