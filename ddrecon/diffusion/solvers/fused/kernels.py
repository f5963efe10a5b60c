"""The kernels of multigrid, which headers have, and the numbers by which these call their parts."""

from __future__ import annotations

import functools
import re
from pathlib import Path

from ddrecon.diffusion.solvers.hierarchy import STEPS
from ddrecon.kernels.text import TextKernel

_ROOM = "diffusion/solvers/fused"
SLOTS = 13
"""Slices that a share of a leg keeps."""


def _names(header: str, enum: str) -> dict[str, int]:
    """The names of an `enum` in a `header`, with their numbers."""
    text = Path(__file__).with_name(header).read_text(encoding="utf-8")
    (names,) = re.findall(rf"enum {enum} \{{([^}}]*)\}}", text)
    return {name.strip(): number for number, name in enumerate(names.split(","))}


COLUMNS = _names("levels.h", "Column")
SUMS = _names("levels.h", "Sum")
VECTORS = _names("levels.h", "Vector")
ACTS = _names("gradients.h", "Act")
MAKING = _names("prepare.h", "Step")


@functools.cache
def prepare_kernel(bits: int) -> TextKernel:
    """A step of making a hierarchy, in a row of cells."""
    text = """
    const Row row(item, width, rows, colors);
    const Mesh<F> mesh(row, nz, ny, nx, F(1), F(1), F(1));
    prepare(row, mesh, step, axis, ny, finer, matrix, made);
    """
    given = "int width, rows, colors, nz, ny, nx, step, axis, finer[3]; F *matrix[4], *made[6]"
    return TextKernel("prepare", bits, text, given, "made", f"{_ROOM}/prepare.h")


@functools.cache
def solve_kernel(bits: int) -> TextKernel:
    """An `act` of a solve, for one of the parts of the slices of a color."""
    text = f"""
    const int color = item / parts, part = item - color * parts;
    const Solve<F> solve = {{
        {{table, {{F({STEPS[0]!r}), F({STEPS[1]!r})}}}}, vectors, sums, first_vector, vector_size,
        tolerance, tiny, matrices, colors, shares, color, part, 0}};
    F *const mine = coarser + color * share, *const memory = scratch + item * scratch_size;
    iterate(solve, act, first, last, mine, memory);
    """
    given = """
    int act, first, last, parts, matrices, colors, shares; double tolerance, tiny, *sums;
    long *table, first_vector, vector_size, scratch_size, share;
    F *vectors, *scratch, *coarser
    """
    made = "vectors scratch sums coarser"
    return TextKernel("multigrid", bits, text, given, made, f"{_ROOM}/gradients.h")
