"""Kernels of pixels between the rays of a lattice: values, where they are in doubt, the adjoint.

An item is `length` pixels, or a row of the lattice. Pixels go in packets, as rays do; the lattice
is a slice whose cells are its rays, and values are to third order (`numerics.third_order`).
"""

from __future__ import annotations

import functools

from ddrecon.kernels.packets import PACKETS
from ddrecon.kernels.text import BLOCK, TextKernel
from ddrecon.march.fused.packet_cells import PLACES, VALUES
from ddrecon.march.fused.packet_runs import ROWS, RUNS, WINDOWS
from ddrecon.march.fused.packet_spread import SHARES

TILE = 2
"""Rows of the lattice whose rough pixels are neighbors: as high as a voxel."""

_LATTICE = "F *values; int channels, rows, columns;"
_PIXELS = _LATTICE + "int length, total, pixels; F *places; long *hit;"
_PACKET = (
    BLOCK
    + PLACES
    + VALUES
    + RUNS
    + ROWS
    + WINDOWS
    + """
const int size = rows * columns, last = total - 1;
const Lines lines = {rows, columns, columns, 1};
struct Packet {
    Place y, x;
    Corners q;
    int runs;
#if !defined(__CUDA_ARCH__)
    Run run[LANES];
    bool is_in_runs;
#endif
};
auto packet_at = [&](int n) -> Packet {
    Packet packet;
    packet.y = Place::at(P::load(places, n, 2, last), rows);
    packet.x = Place::at(P::load(places + 1, n, 2, last), columns);
    packet.q = Corners::of(packet.y, packet.x, lines);
#if !defined(__CUDA_ARCH__)
    packet.runs = find_runs(packet.y, packet.x, lines, packet.run);
    packet.is_in_runs = HAS_PERMUTATION && columns >= LANES && packet.runs <= MOST_RUNS;
#endif
    return packet;
};
auto value_at = [&](const Packet& packet, const F* v) -> V {
    V bend = P::all(F(0)), value = bend;
#if !defined(__CUDA_ARCH__)
    if (packet.is_in_runs) {
        for (int r = 0; r < packet.runs; ++r) {
            const Window w = Window::of(packet.run[r], packet.y, packet.x, lines);
            const V found = w.curved(v, packet.y, packet.x, bend);
            value = P::pick(w.is_in, found - bend, value);
        }
        return value;
    }
#endif
    value = Values::curved(v, packet.q, packet.y, packet.x, lines, bend);
    return value - bend;
};
// Whether pixels n on, as many as lanes, are neighbors in an image.
auto is_whole = [&](int n) -> bool {
    return n + LANES <= end && hit[n + LANES - 1] - hit[n] == LANES - 1;
};
"""
)
_INTERPOLATE = """
for (int n = begin; n < end; n += LANES) {
    const Packet packet = packet_at(n);
    for (int k = 0; k < channels; ++k) {
        const V found = value_at(packet, &values[k * size]);
        const V value = P::pick(found < P::all(F(0)), P::all(F(0)), found);
        F* row = &out[k * (long long)pixels];
        if (is_whole(n)) P::write(row + hit[n], value);
        else for (int l = 0; l < LANES && n + l < end; ++l) row[hit[n + l]] = P::lane(value, l);
    }
    const Corners& q = packet.q;
    const V most = P::most(P::most(P::gather(uneven, q.at00), P::gather(uneven, q.at01)),
                           P::most(P::gather(uneven, q.at10), P::gather(uneven, q.at11)));
    for (int l = 0; l < LANES && n + l < end; ++l) {
        const int row = P::lane_of(packet.y.i, l) / TILE;
        const F column = F(P::lane_of(packet.x.i, l)) + P::lane(packet.x.a, l);
        const int place = 1 + 16 * row * columns + (int)(F(16) * column);
        rough[n + l] = P::lane(most, l) > bound[0] ? place : 0;
    }
}
"""
_SPREAD = """
constexpr int MOST = 6;
for (int n = begin; n < end; n += LANES) {
    const Packet packet = packet_at(n);
    // So many channels at a time.
    for (int first = 0; first < channels; first += MOST) {
        const int count = channels - first < MOST ? channels - first : MOST;
        V bars[MOST];
        for (int k = 0; k < count; ++k) {
            const F* row = &out_bar[(first + k) * (long long)pixels];
            V bar = P::all(F(0));
            if (is_whole(n)) bar = P::read(row + hit[n]);
            else for (int l = 0; l < LANES && n + l < end; ++l) P::put(bar, l, row[hit[n + l]]);
            // What was held at zero does not move.
            const V found = value_at(packet, &values[(first + k) * size]);
            bars[k] = P::pick(found < P::all(F(0)), P::all(F(0)), bar);
        }
        F* const field = &values_bar[first * size];
#if defined(__CUDA_ARCH__)
        const Shares shares = Shares::of(packet.y, packet.x, lines);
        for (int k = 0; k < count; ++k) shares.add(field + k * size, bars[k], -bars[k]);
#else
        for (int r = 0; r < packet.runs; ++r) {
            const Shares shares = Shares::of(packet.run[r], packet.y, packet.x, lines, ones, true);
            for (int k = 0; k < count; ++k) shares.add_bent(field + k * size, bars[k], -bars[k]);
        }
#endif
    }
}
"""
# Fourth differences of radiance and of what is seen of `behind`, their magnitudes summed; and the
# sum of the squares of what is seen, of a row.
_JUDGE = """
const int size = rows * columns;
const int colors = channels / 2, row = item;
const F light = behind[0];
auto fourth = [](const F* v, int at, int count, int stride) -> F {
    auto value = [&](int i) -> F {
        return v[(i < 0 ? 0 : (i < count ? i : count - 1)) * stride];
    };
    auto second = [&](int i) -> F {
        i = i < 0 ? 0 : (i < count ? i : count - 1);
        return value(i - 1) - F(2) * value(i) + value(i + 1);
    };
    const F total = second(at - 1) - F(2) * second(at) + second(at + 1);
    return total < F(0) ? -total : total;
};
double square = 0.0;
for (int j = 0; j < columns; ++j) {
    F total = F(0);
    for (int k = 0; k < 2 * colors; ++k) {
        const F* __restrict v = &values[k * size];
        const F part = fourth(v + j, row, rows, columns) + fourth(v + row * columns, j, columns, 1);
        total += (k < colors ? F(1) : light) * part;
    }
    uneven[row * columns + j] = total;
    for (int k = 0; k < colors; ++k) {
        const int cell = k * size + row * columns + j;
        const F seen = values[cell] + light * (F(1) - values[colors * size + cell]);
        square += (double)(seen * seen);
    }
}
squares[row] = square;
"""


@functools.cache
def judge_kernel(bits: int) -> TextKernel:
    """The kernel that finds `uneven` [r, c], and sums of `squares` [r] of what is seen.

    Of `values` [2 C, r, c], radiance and opacity, with light `behind` [1].
    """
    given = _LATTICE + "F *behind, *uneven; double *squares"
    return TextKernel("judge", bits, _JUDGE, given, "uneven squares")


@functools.cache
def interpolation_kernel(bits: int) -> TextKernel:
    """The kernel of values at `places` [P, 2]: those of `out` [2 C, pixels] at rays `hit` [P].

    And which of them are `rough` [P], whose neighbors are more `uneven` than `bound` [1]: a number
    that grows along rows of tiles, else 0.
    """
    text = f"constexpr int TILE = {TILE};" + _PACKET + _INTERPOLATE
    more = "F *uneven, *bound, *out; int *rough"
    return TextKernel("interpolate", bits, PACKETS + text, _PIXELS + more, "out rough")


@functools.cache
def spread_kernel(bits: int) -> TextKernel:
    """The kernel that adds to `values_bar` [2 C, r, c] what `out_bar` [2 C, pixels] is for them."""
    text, more = _PACKET + SHARES + _SPREAD, "F *out_bar, *values_bar"
    return TextKernel("spread", bits, PACKETS + text, _PIXELS + more, "values_bar")
