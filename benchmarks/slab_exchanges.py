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
    """A run on n x 1.5 n x n cells, in slabs across the long axis.

    Light is solved for to `tolerance`, in so many `cycles`, forward and adjoint together.
    """

    n: int
    colors: int
    views: int
    ranks: int
    tolerance: float = 1e-3
    cycles: int = 0

    @property
    def distances(self) -> float:
        """Cells of the coarse grid of distances, if they were as thin as those of the grid."""
        grid = Grid.from_xyz((self.n, self.n * 3 // 2, self.n), (0, 0, 0), (1, 1, 1))
        return coarse_grid(grid).shape[0] ** 2 * 1.5 * self.n

    @property
    def cells(self) -> float:
        """How many cells there are."""
        return 1.5 * self.n**3

    @property
    def face(self) -> int:
        """Cells of a layer across the long axis."""
        return self.n**2

    @property
    def rays(self) -> int:
        """Pixels of all views."""
        return self.views * (PIXELS * self.n) ** 2


SWAP, GATHER, SUM = "swap_with_neighbors", "gather_from_ranks", "sum_over_ranks"
"""Exchanges: with neighbors; of a part that each has; of sums that all get."""
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
    (GATHER, "views"): {"pixels": lambda c: c.rays},
    (SUM, "views"): {
        "pixels x ranks": lambda c: c.rays * c.ranks,
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
        is_large = name in (SWAP, GATHER, SUM) and count > FEW
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

    `factors` are bytes a unit of what they grow with; `error` is that of the fit. Calls are so many
    a cycle, and as many again.
    """

    kind: str
    purpose: str
    factors: tuple[float, ...]
    error: float
    calls: tuple[float, float]

    def seconds(self, case: Case, link: float) -> float:
        """How long they take in `case` by links of so many bytes a second."""
        grown = LAWS.get((self.kind, self.purpose), {}).values()
        part = sum(f * law(case) for f, law in zip(self.factors, grown, strict=True))
        # Neighbors swap at the same time; a ring hands on all parts, or each sum twice.
        others = case.ranks - 1
        often = {SWAP: 1.0, GATHER: others, SUM: 2 * others / case.ranks}
        calls = self.calls[0] * case.cycles + self.calls[1]
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
        cycles = np.array([[case.cycles, 1.0] for case, _ in counted])
        often = np.linalg.lstsq(cycles, calls, rcond=None)[0]
        factors, error = np.zeros(0), 0.0
        if law_of := LAWS.get((kind, purpose)):
            matrix = np.array([[law(case) for law in law_of.values()] for case, _ in counted])
            scale = 1 / np.maximum(bytes_, 1)[:, None]
            factors = np.linalg.lstsq(matrix * scale, bytes_ * scale[:, 0], rcond=None)[0]
            error = float(np.abs((matrix @ factors) * scale[:, 0] - 1).max())
        laws.append(Law(kind, purpose, tuple(factors), error, (often[0], often[1])))
    return laws


def print_laws(laws: list[Law]) -> None:
    """Prints what was fitted."""
    print("| exchange | for | bytes | calls | fit |\n|---|---|---|---|---|")
    for law in laws:
        grown = LAWS.get((law.kind, law.purpose), {})
        shown = " + ".join(f"{f:.3g} x {name}" for f, name in zip(law.factors, grown, strict=True))
        calls = f"{law.calls[0]:.1f} a cycle + {law.calls[1]:.1f}"
        print(f"| {law.kind} | {law.purpose} | {shown} | {calls} | {100 * law.error:.0f} % |")


def main() -> None:
    """Prints what was counted and fitted, and the table of GPUs."""
    torch.set_num_threads(1)
    use_engine("torch")
    laws = fit([count(case) for case in CASES])
    print_laws(laws)
    use_engine("auto")
    rows = [parts_of(size, rounds=0) for size in (48, 64)]
    fixed, view, cells, sent = (sum(column) for column in zip(*rows, strict=True))
    speed = memory_speed()
    faster = GPU_MEMORY / speed
    print(f"\na cell: {1e9 * fixed / cells:.1f} ns and {1e9 * view / cells:.1f} a view", end=" ")
    print(f"on this thread; a GPU counts as {faster:.0f} of it\n")
    print(
        "| cells | views | GPUs | views shared [s] | cells shared [s] | exchanges [s] | GB each |"
    )
    print("|---|---|---|---|---|---|---|")
    for side in (256, 512, 1024):
        room = memory_of(Needs((side,) * 3, 3, 4, 0, has_rounds=False, varied=1.0))
        for views in (10, 50, 200):
            for ranks, link in LINKS.items():
                light, looking = (part / cells * side**3 / faster for part in (fixed, view))
                ring = 2 * (ranks - 1) / ranks * sent / cells * side**3 / link
                shared = light + -(-views // ranks) * looking + ring
                told = f"| {side}^3 | {views} | {ranks} | {shared:.2f} |"
                thick = side / ranks
                if ranks == 1 or thick < THINNEST:
                    each = room if ranks == 1 else math.nan
                    note = "" if ranks == 1 else "too thin"
                    print(f"{told} {note} | | {each / 1e9:.0f} |")
                    continue
                # A slab computes its halo as well; coarse grids, a seventh, are everybody's.
                own = (thick + 2 * HALO) / thick / ranks
                coarse = light / 7
                # A cube has one and a half times less than what is fitted has along the long axis.
                case = replace(Case(side, 3, views, ranks, CYCLES))
                exchanges = sum(law.seconds(case, link) for law in laws)
                total = (light - coarse + views * looking) * own + coarse + exchanges
                whole = PARAMETERS * side**3
                each = (room - whole) * own + whole
                mark = "" if each < GPU_ROOM else " (too much)"
                print(f"{told} {total:.2f} | {exchanges:.2f} | {each / 1e9:.0f}{mark} |")


if __name__ == "__main__":
    main()
