"""Which segments of rays are walked: those that a volume's support touches (E35).

Between two nodes whose cells all lie outside there is no matter and never will be: the segment adds
nothing, and to no derivative that is asked for. A packet of rays has a bit for each segment, found
once for rays and a support that stay.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from ddrecon.kernels.packets import LANES, packet_program
from ddrecon.kernels.text import TextKernel, cut
from ddrecon.march.fused.packet_cells import PLACES
from ddrecon.numerics.remember import remember

BITS = 32
"""Segments in a word; segment n lies between nodes n - 1 and n."""

WALKS = """
auto walks = [&](int n) -> bool {
    return !walked || (walked[(long long)item * words + n / 32] >> (n % 32) & 1);
};
"""
"""C++ of a packet `item`: whether its segment n is to be walked."""

_MARK = """
const int last = ray_count - 1, begin = item * LANES;
const V o0 = P::load(rays, begin, 8, last), d0 = P::load(rays + 3, begin, 8, last);
const V o1 = P::load(rays + 1, begin, 8, last), d1 = P::load(rays + 4, begin, 8, last);
const V o2 = P::load(rays + 2, begin, 8, last), d2 = P::load(rays + 5, begin, 8, last);
const V near = P::load(rays + 6, begin, 8, last), far = P::load(rays + 7, begin, 8, last);
const V none = P::all(F(0)), one = P::all(F(1));
V before = none, touched_before = none;
unsigned word = 0;
for (int n = 0; n < node_count; ++n) {
    // Which lanes' cells at node n the support touches.
    const V s = (planes[n] - o0) / d0;
    const Place y = Place::at(o1 + s * d1, rows), x = Place::at(o2 + s * d2, columns);
    const I cell = y.i * columns + x.i;
    const bool* slice = touched + (long long)n * rows * columns;
    V touches = none;
    for (int l = 0; l < LANES; ++l) P::put(touches, l, F(slice[P::lane_of(cell, l)]));
    // And which lanes' segments before it lie in the box.
    const V inside = P::pick((s > near) & (before < far) & (near < far), one, none);
    if (n > 0 && !P::every(inside * (touches + touched_before) == none)) word |= 1u << (n % 32);
    if (n % 32 == 31 || n == node_count - 1) {
        walked[(long long)item * words + n / 32] = (int)word;
        word = 0;
    }
    before = s;
    touched_before = touches;
}
"""


@functools.cache
def mark_kernel(bits: int) -> TextKernel:
    """The kernel that finds which segments of a packet of rays touch cells of a support."""
    given = """
    F *planes, *rays; bool *touched; int *walked;
    int ray_count, node_count, rows, columns, words;
    """
    return TextKernel("mark", bits, PLACES + _MARK, given, "walked", packet_program)


@remember
def find_walked(support: Tensor, planes: Tensor, rays: Tensor) -> Tensor:
    """Bits of the segments that packets of `rays` are to walk, int32 [packets, words].

    `support` [N, rows, columns] is that of the slices in which nodes lie, as `planes` [N] do.
    """
    touched, nodes = _touched(support), len(planes)
    packets, _ = cut(len(rays), LANES, rays)
    words = -(-nodes // BITS)
    walked = rays.new_empty(packets, words, dtype=torch.int32)
    given = {"planes": planes, "rays": rays, "touched": touched, "ray_count": len(rays)}
    given |= {"node_count": nodes, "rows": support.shape[1], "columns": support.shape[2]}
    mark_kernel(torch.finfo(rays.dtype).bits).launch(
        packets, given | {"words": words}, {"walked": walked}
    )
    return walked


@remember
def _touched(support: Tensor) -> Tensor:
    """Whether a cell, or the next row's or column's, is of the `support`: as places count them."""
    below = torch.cat([support[:, 1:], support[:, -1:]], 1)
    rows = support | below
    return rows | torch.cat([rows[:, :, 1:], rows[:, :, -1:]], 2)
