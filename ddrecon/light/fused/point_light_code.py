"""C++ of the inner loops of `fused.point_light`: samples along ways, a block of ways at a time."""

from __future__ import annotations

_WAYS = """
#if defined(__CUDA_ARCH__)
enum { BLOCK = 1 };
#else
enum { BLOCK = 128 };
#endif
const int P = ways, M = samples, begin = item * BLOCK;
const int count = begin + BLOCK < P ? BLOCK : P - begin;
const int D = depth, H = height, W = width;
const size_t cells = size_t(D) * H * W;
const int up_z = D > 1 ? H * W : 0, up_y = H > 1 ? W : 0, up_x = W > 1 ? 1 : 0;
const F* __restrict first = firsts + begin;
const F* __restrict last = lasts + begin;
const F* __restrict length = lengths + begin;

// The cell before place `p` on a line of `size` cells, and the part of the way to the next one.
struct Place { int n; F a; };
auto place_of = [](F p, int size) -> Place {
    const F most = F(size - 1), held = p < F(0) ? F(0) : p > most ? most : p;
    const int whole = (int)held, final = size > 1 ? size - 2 : 0, n = whole < final ? whole : final;
    return Place{n, held - F(n)};
};
auto blend = [](F a, F low, F high) -> F { return low + a * (high - low); };
"""
# Where sample i of way t lies.
_SAMPLE = """
const F f = fraction[i];
const F pz = last[t] - f * (last[t] - first[t]);
const F py = last[t + P] - f * (last[t + P] - first[t + P]);
const F px = last[t + 2 * P] - f * (last[t + 2 * P] - first[t + 2 * P]);
"""
_CORNERS = """
const Place z = place_of(pz, D), y = place_of(py, H), x = place_of(px, W);
const int at = (z.n * H + y.n) * W + x.n;
"""
_VALUES = """
const F v000 = field[at], v001 = field[at + up_x];
const F v010 = field[at + up_y], v011 = field[at + up_y + up_x];
const F v100 = field[at + up_z], v101 = field[at + up_z + up_x];
const F v110 = field[at + up_z + up_y], v111 = field[at + up_z + up_y + up_x];
"""
INTEGRATE = (
    _WAYS
    + """
for (int channel = 0; channel < channels; ++channel) {
    const F* __restrict field = fields + channel * cells;
    F sum[BLOCK];
    for (int t = 0; t < count; ++t) sum[t] = F(0);
    for (int i = 0; i < M; ++i)
        for (int t = 0; t < count; ++t) {
"""
    + _SAMPLE
    + _CORNERS
    + _VALUES
    + """
            const F low = blend(y.a, blend(x.a, v000, v001), blend(x.a, v010, v011));
            const F high = blend(y.a, blend(x.a, v100, v101), blend(x.a, v110, v111));
            sum[t] += blend(z.a, low, high);
        }
    F* __restrict total = totals + size_t(channel) * P + begin;
    for (int t = 0; t < count; ++t) total[t] = sum[t] * length[t] / F(M);
}
"""
)
# The field's cotangent; and where ways vary, that of their ends: where a sample lies on the center
# of a cell its slope is the mean of both sides', `shift` away from it.
ADJOINT = (
    _WAYS
    + """
auto add = [](F* to, F value) {
#if defined(__CUDA_ARCH__)
    wp::atomic_add(to, value);
#else
    *to += value;
#endif
};
const F near = F(16.0 * (sizeof(F) == 8 ? 0x1p-52 : 0x1p-23));
auto shift_of = [&](F p, int size) -> F {
    const F held = p < F(0) ? F(0) : p, off = held - F((int)(held + F(0.5)));
    return p >= -near * size && (off < F(0) ? -off : off) < near * size ? F(4) * near * size : F(0);
};
// The slope along an axis is none beyond the outermost centers.
auto slope_of = [](F p, int size, F low, F high) -> F {
    return p > F(0) && p < F(size - 1) ? high - low : F(0);
};
for (int channel = 0; channel < channels; ++channel) {
    const F* __restrict field = fields + channel * cells;
    F* __restrict field_bar = fields_bar + channel * cells;
    const F* __restrict bar = totals + size_t(channel) * P + begin;
    F part[BLOCK], az[BLOCK], ay[BLOCK], ax[BLOCK];
    int corner[BLOCK];
    for (int t = 0; t < count; ++t) part[t] = bar[t] * length[t] / F(M);
    for (int i = 0; i < M; ++i) {
        for (int t = 0; t < count; ++t) {
"""
    + _SAMPLE
    + _CORNERS
    + """
            corner[t] = at, az[t] = z.a, ay[t] = y.a, ax[t] = x.a;
        }
        for (int t = 0; t < count; ++t) {
            F* const to = field_bar + corner[t];
            const F high = part[t] * az[t], low = part[t] - high;
            const F low_high = low * ay[t], low_low = low - low_high;
            const F high_high = high * ay[t], high_low = high - high_high;
            add(to, low_low - low_low * ax[t]), add(to + up_x, low_low * ax[t]);
            add(to + up_y, low_high - low_high * ax[t]), add(to + up_y + up_x, low_high * ax[t]);
            add(to + up_z, high_low - high_low * ax[t]), add(to + up_z + up_x, high_low * ax[t]);
            add(to + up_z + up_y, high_high - high_high * ax[t]);
            add(to + up_z + up_y + up_x, high_high * ax[t]);
        }
    }
    if (!varies) continue;
    F* __restrict first_bar = firsts_bar + begin;
    F* __restrict last_bar = lasts_bar + begin;
    F* __restrict length_bar = lengths_bar + begin;
    for (int i = 0; i < M; ++i)
        for (int t = 0; t < count; ++t) {
"""
    + _SAMPLE
    + """
            const F sz = shift_of(pz, D), sy = shift_of(py, H), sx = shift_of(px, W);
            F slope[3] = {F(0), F(0), F(0)}, value = F(0);
            auto look = [&](F pz, F py, F px) {
"""
    + _CORNERS
    + _VALUES
    + """
                const F v00 = blend(x.a, v000, v001), v01 = blend(x.a, v010, v011);
                const F v10 = blend(x.a, v100, v101), v11 = blend(x.a, v110, v111);
                const F v0 = blend(y.a, v00, v01), v1 = blend(y.a, v10, v11);
                value += F(0.5) * blend(z.a, v0, v1);
                slope[0] += F(0.5) * slope_of(pz, D, v0, v1);
                slope[1] += F(0.5) * slope_of(py, H, blend(z.a, v00, v10), blend(z.a, v01, v11));
                slope[2] += F(0.5) * slope_of(px, W,
                    blend(z.a, blend(y.a, v000, v010), blend(y.a, v100, v110)),
                    blend(z.a, blend(y.a, v001, v011), blend(y.a, v101, v111)));
            };
            look(pz - sz, py - sy, px - sx);
            look(pz + sz, py + sy, px + sx);
            for (int axis = 0; axis < 3; ++axis) {
                first_bar[t + axis * P] += f * part[t] * slope[axis];
                last_bar[t + axis * P] += (F(1) - f) * part[t] * slope[axis];
            }
            length_bar[t] += bar[t] * value / F(M);
        }
}
"""
)
