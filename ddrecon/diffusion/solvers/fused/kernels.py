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
LEGS = _names("cycle.h", "Leg")
ACTS = _names("gradients.h", "Act")
MAKING = _names("prepare.h", "Step")
_SOLVE = """
int item_parts, iteration, matrices, all_colors, shares; double tolerance, tiny, *sums;
long *table, first_vector, vector_size, scratch_size; F *data, *vectors, *scratch;
"""
_ITEM = f"""
const int color = item / item_parts, part = item - color * item_parts;
const Solve<F> solve = {{
    {{table, data, {{F({STEPS[0]!r}), F({STEPS[1]!r})}}}}, vectors, sums, first_vector, vector_size,
    tolerance, tiny, matrices, all_colors, shares, color, part, iteration & 1}};
F* const memory = scratch + item * scratch_size;
"""


@functools.cache
def prepare_kernel(bits: int) -> TextKernel:
    """A step of making a hierarchy, for a share of the cells of a color."""
    text = """
    const Maker<F> make(table, matrix, is_each, data, work, scratch, item);
    prepare(make, step, stage, item, colors, parts, finest_parts, strengths);
    """
    given = """
    int step, stage, colors, parts, finest_parts, is_each[4]; long *table;
    F *matrix[4], *data, *work, *scratch; double *strengths
    """
    made = "data work scratch strengths"
    return TextKernel("prepare", bits, text, given, made, f"{_ROOM}/prepare.h")


@functools.cache
def cycle_kernel(bits: int) -> TextKernel:
    """A `leg` of the cycle, for one of the parts of the slices of a color."""
    text = _ITEM + "cycle(solve, leg, item_parts, coarser + color * share, memory);"
    given, made = _SOLVE + "int leg; F *coarser; long share", "vectors scratch sums coarser"
    return TextKernel("cycle", bits, text, given, made, f"{_ROOM}/cycle.h")


@functools.cache
def gradient_kernel(bits: int) -> TextKernel:
    """An `act` of conjugate gradients, for one of the shares of the slices of a color."""
    text = _ITEM + "iterate(solve, act, iteration, source, guess, memory);"
    given, made = _SOLVE + "int act; F *source, *guess", "vectors scratch sums"
    return TextKernel("advance", bits, text, given, made, f"{_ROOM}/gradients.h")
