"""C++ of packets of rays: what a ray and a node are, where nodes lie, and what they emit.

The text of a kernel is constants of the layout, all structs, what comes before every walk, and the
walk.
"""

from __future__ import annotations

from ddrecon.kernels.packets import PACKETS
from ddrecon.kernels.text import TextKernel
from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.packet_cells import PLACES, VALUES
from ddrecon.march.fused.packet_cellwise import RUNGS, SEE
from ddrecon.march.fused.packet_layout import Case, layout_constants
from ddrecon.march.fused.packet_optics import CUBICS, DECAYS, POINTS, POLYNOMIALS
from ddrecon.march.fused.packet_runs import ROWS, RUNS, WINDOWS
from ddrecon.march.fused.stretches import WALKS

GIVEN = """
F *planes, *rays, *angles, *coefficients, *numbers, *table, *fronts; int *slices, *walked, *dealt;
int ray_count, node_count, depth, rows, columns, words;
int plane_stride, row_stride, column_stride;
"""
"""Nodes lie in `slices` [N] of `fields`, channels of cells, at `planes` [N] across them [u]; or,
where these are not IS_SLICED, anywhere: at such parts of the way from near to far.

`rays` [R, 8]: origin and direction (in cells; across slices in u), near, far [u]. `angles`
[2 beams, R]: the cosine to directional light, or the foot of a point light, then its square
distance. `coefficients` [beams * phases * COEFFICIENTS, R]: the polynomials of E13, or what
`cellwise` has. `numbers`: scale and peak by color, bound of third-order corrections. `table`
[phases * (steps + 1) * 2, terms]: polynomials of point lights by angle. `fronts` [K, R]: the mass
before the rays, if any. `walked` [packets, words]: bits of the segments to be walked. Item i is
packet i, or `dealt` [packets] says which.
"""

_RECORDS = """
struct Ray {
    V o0, o1, o2, d0, d1, d2, near, far;
    V foot[BEAMS + 1], across[BEAMS + 1], coefficients[BEAMS * RAY_TERMS + 1];
};
// Where a node lies among cells.
struct Spot {
    Place z, y, x;
    Corners q;
    int runs;
#if !defined(__CUDA_ARCH__)
    Run run[LANES];
#endif
};
// Whether it `is_empty` for all lanes, and `is_lit`, has all its values; distances `s` sampled at
// and `t` held in the box; values; emission, depth, exp(-depth), and p; of light from points their
// angle, and the coefficients of p over the depth of the peak. Where p differs from cell to cell,
// how these change with the number and with the angle's place in tables; and p without a peak.
struct Node : Spot {
    bool is_empty, is_lit;
    V s, t, v[CHANNELS], bend[MASSES + 1], held[MASSES + 1], w[OUT], u[OUT], decay[OUT], p[OUT];
    Cubic point[BEAMS + 1];
    V curve[CURVES + 1], by_number[HAS_SLOPES * CURVES + 1], by_angle[HAS_SLOPES * CURVES + 1];
    Plain plain[IS_STEEP * BEAMS * PHASES + 1];
};
"""
ROW_OF = """
// Where row k of an array begins that has a number of each ray.
auto row_of = [&](int k) -> long long { return (long long)k * ray_count; };
"""
_BEGIN = """
if (dealt) item = dealt[item];
const int last = ray_count - 1, begin = item * LANES;
const F* scale = numbers;
const F* peaks = numbers + C;
const F bound = numbers[2 * C];
Ray ray;
const V none = P::all(F(0));
ray.o0 = P::load(rays, begin, 8, last);
ray.o1 = P::load(rays + 1, begin, 8, last);
ray.o2 = P::load(rays + 2, begin, 8, last);
ray.d0 = P::load(rays + 3, begin, 8, last);
ray.d1 = P::load(rays + 4, begin, 8, last);
ray.d2 = P::load(rays + 5, begin, 8, last);
ray.near = P::load(rays + 6, begin, 8, last);
ray.far = P::load(rays + 7, begin, 8, last);
for (int b = 0; b < BEAMS; ++b) {
    ray.foot[b] = P::load(angles + row_of(b), begin, 1, last);
    ray.across[b] = P::load(angles + row_of(BEAMS + b), begin, 1, last);
}
if (HAS_PEAK || HAS_NUMBERS)
    for (int k = 0; k < BEAMS * RAY_TERMS; ++k)
        ray.coefficients[k] = P::load(coefficients + row_of(k), begin, 1, last);
auto distance = [&](int n) -> V {
    return IS_SLICED ? (planes[n] - ray.o0) / ray.d0 : ray.near + planes[n] * (ray.far - ray.near);
};
auto front_of = [&](const F* masses, int k) -> V {
    return masses ? P::load(masses + row_of(k), begin, 1, last) : P::all(F(0));
};
// Nodes before the box and behind it are held at its faces: between them nothing is added.
int first_node = 0, last_node = node_count - 1;
while (first_node < last_node && P::every(distance(first_node + 1) <= ray.near)) ++first_node;
while (last_node > first_node && P::every(distance(last_node - 1) >= ray.far)) --last_node;
if (P::every(ray.near >= ray.far)) last_node = first_node;
// The next stretch of segments to be walked behind node `to`, and the one before node `from`: nodes
// `from` to `to`; whether there is one.
auto next_stretch = [&](int& from, int& to) -> bool {
    for (from = to; from < last_node && !walks(from + 1);) ++from;
    for (to = from; to < last_node && walks(to + 1);) ++to;
    return from < to;
};
auto stretch_before = [&](int& from, int& to) -> bool {
    for (to = from; to > first_node && !walks(to);) --to;
    for (from = to; from > first_node && walks(from);) --from;
    return from < to;
};
// Along y the packet's rays are closer together than along x; it `is_turned` where y are columns.
bool is_turned = false;
Lines lines = {rows, columns, row_stride, column_stride};
if (LANES > 1 && IS_SLICED) {
    const V s = distance((first_node + last_node) / 2);
    const V y = ray.o1 + s * ray.d1, x = ray.o2 + s * ray.d2;
    const int end = begin + LANES <= last ? LANES - 1 : last - begin;
    const F high = P::lane(y, end) - P::lane(y, 0), wide = P::lane(x, end) - P::lane(x, 0);
    if (high * high > wide * wide) {
        is_turned = true;
        lines = {columns, rows, column_stride, row_stride};
        const V o = ray.o1, d = ray.d1;
        ray.o1 = ray.o2;
        ray.d1 = ray.d2;
        ray.o2 = o;
        ray.d2 = d;
    }
}
auto slice = [&](int n) -> long long { return (long long)slices[n] * plane_stride; };
// Values of channels `from` to before `to`, of each lane by itself.
auto sample_lanes = [&](Node& node, long long offset, int from, int to) {
    for (int c = from; c < to; ++c) {
        const F* field = fields[c] + offset;
        const int k = c - FIRST_MASS;
        node.v[c] = k >= 0 && k < MASSES
            ? Values::curved(field, node.q, node.y, node.x, lines, node.bend[k])
            : Values::linear(field, node.q);
    }
};
#if !defined(__CUDA_ARCH__)
auto sample_runs = [&](Node& node, long long offset, int from, int to) {
    for (int r = 0; r < node.runs; ++r) {
        const Window w = Window::of(node.run[r], node.y, node.x, lines);
        for (int c = from; c < to; ++c) {
            const F* field = fields[c] + offset;
            const int k = c - FIRST_MASS;
            V bend = P::all(F(0));
            const bool is_bent = k >= 0 && k < MASSES;
            const V v = is_bent ? w.curved(field, node.y, node.x, bend) : w.linear(field);
            node.v[c] = P::pick(w.is_in, v, node.v[c]);
            if (is_bent) node.bend[k] = P::pick(w.is_in, bend, node.bend[k]);
        }
    }
};
#endif
auto sample_between = [&](Node& node, int from, int to) {
    const Layers layers = Layers::of(node.z);
    for (int c = from; c < to; ++c) {
        const int k = c - FIRST_MASS;
        const bool is_bent = k >= 0 && k < MASSES;
        V total = P::all(F(0)), total_bend = P::all(F(0));
        for (int i = 0; i < 4; ++i) {
            if (Layers::is_outer(i) && !is_bent) continue;
            const Place y = Place::behind(node.y, layers.at[i] * lines.rows);
            const Corners q = Corners::of(y, node.x, lines);
            V bend = P::all(F(0));
            const V v = is_bent && !Layers::is_outer(i)
                ? Values::curved(fields[c], q, y, node.x, lines, bend)
                : Values::linear(fields[c], q);
            total += layers.linear[i] * v;
            total_bend += layers.linear[i] * bend + layers.across[i] * v;
        }
        node.v[c] = total;
        if (is_bent) node.bend[k] = total_bend;
    }
};
auto sample = [&](Node& node, int n, int from, int to) {
    if (!IS_SLICED) return sample_between(node, from, to);
#if !defined(__CUDA_ARCH__)
    if (HAS_PERMUTATION && node.runs <= MOST_RUNS && lines.columns >= LANES)
        sample_runs(node, slice(n), from, to);
    else
#endif
        sample_lanes(node, slice(n), from, to);
};
// The cells around a place in a slice.
auto find_cells = [&](Spot& spot) {
    spot.q = Corners::of(spot.y, spot.x, lines);
#if !defined(__CUDA_ARCH__)
    spot.runs = find_runs(spot.y, spot.x, lines, spot.run);
#endif
};
// Where node n lies, and the matter there.
auto locate = [&](int n, Node& node) {
    node.s = distance(n);
    node.t = P::least(P::most(node.s, ray.near), ray.far);
    node.y = Place::at(ray.o1 + node.s * ray.d1, lines.rows);
    node.x = Place::at(ray.o2 + node.s * ray.d2, lines.columns);
    if (IS_SLICED) find_cells(node);
    else node.z = Place::at(ray.o0 + node.s * ray.d0, depth);
    sample(node, n, 0, EXTINCTION);
    if (SCATTERING) sample(node, n, FIRST_OWN_SCATTERING, FIRST_PEAK);
    node.is_empty = true;
    for (int c = 0; c < EXTINCTION; ++c)
        node.is_empty = node.is_empty && P::every(node.v[c] == P::all(F(0)));
    for (int c = FIRST_OWN_SCATTERING; c < FIRST_PEAK; ++c)
        node.is_empty = node.is_empty && P::every(node.v[c] == P::all(F(0)));
};
"""
_EMIT = """
auto peak_of = [&](const Node& node, int c) -> V {
    return IS_PEAK_FIELD ? node.v[FIRST_PEAK + c * PEAK_STEP] : P::all(peaks[c]);
};
auto first_of = [&](int b, int c) -> int {
    return b * RAY_TERMS + c * CURVE_STEP;
};
// Of p of beam b in color c: coefficients over the depth of the peak.
auto curve_of = [&](const Node& node, int b, int c) -> const V* {
    if (!IS_POINT[b] && !HAS_RUNGS) return ray.coefficients + first_of(b, c);
    return node.curve + (b * PHASES + c * PHASE_STEP) * TERMS;
};
// Whether p of a beam is by such coefficients at all, and in which lanes it is.
auto has_curve = [&](int b) -> bool {
    return HAS_PEAK || IS_LINEAR || (IS_POINT[b] && !IS_STEEP);
};
auto is_peaked = [&](const Node& node, int c) -> M {
    return (IS_STEEP ? number_of(node, c * PHASE_STEP) : P::all(F(1))) > P::all(F(0));
};
// Where on that curve p is behind mass on both ways: by the depth of the peak, or by the number.
auto place_of = [&](const Node& node, int c, V way) -> V {
    if (HAS_PEAK) return Polynomial::place(peak_of(node, c) * way);
    return IS_LINEAR ? number_of(node, c * PHASE_STEP) : P::all(F(0));
};
// All else at node n: all outputs' emission, depth and p behind the mass `m`; if p of light from
// one direction `turns` with that, how p changes as well.
auto emit = [&](int n, Node& node, const W* m, bool turns = false) {
    sample(node, n, EXTINCTION, FIRST_OWN_SCATTERING);
    if (FIRST_PEAK < CHANNELS) sample(node, n, FIRST_PEAK, CHANNELS);
    for (int k = 0; k < MASSES; ++k) {
        const V bent = bound * node.bend[k];
        node.held[k] = P::inverse_root(F(1) + bent * bent);
        node.v[FIRST_MASS + k] -= node.bend[k] * node.held[k];
    }
    for (int c = 0; c < C; ++c) {
        const V scattering = node.v[FIRST_DIFFUSING + c * DIFFUSING_STEP];
        node.w[c] = scattering * node.v[FIRST_DIFFUSE + c * DIFFUSE_STEP];
        node.u[c] = scale[c] * P::narrow(m[c * MASS_STEP]);
    }
    for (int b = 0; b < BEAMS; ++b) {
        if (IS_POINT[b]) {
            node.point[b] = Point::at(ray.foot[b], ray.across[b], node.t);
            for (int h = 0; h < PHASES && !HAS_RUNGS && !IS_STEEP; ++h)
                Point::curve(node.point[b], table + h * TABLE_STEP,
                             node.curve + (b * PHASES + h) * TERMS);
        }
        if (HAS_RUNGS || IS_STEEP) see_number(node, b, IS_POINT[b] ? VARIES_ANGLES : turns);
        for (int c = 0; c < C; ++c) {
            const int i = C + b * C + c;
            const V mass = P::narrow(m[c * MASS_STEP]);
            const V scattering = node.v[FIRST_SCATTERING + c * SCATTERING_STEP];
            const V way = mass + node.v[FIRST_MASS + b * EXTINCTION + c * MASS_STEP];
            V p = P::all(F(1));
            if (has_curve(b)) p = Polynomial::at(curve_of(node, b, c), place_of(node, c, way));
            if (HAS_PEAK) p = P::most(p, P::all(F(0)));
            if (IS_STEEP) {
                const V plain = node.plain[b * PHASES + c * PHASE_STEP].value;
                p = HAS_PEAK ? P::pick(is_peaked(node, c), p, plain) : plain;
            }
            node.p[i] = p;
            node.w[i] = scattering * p;
            node.u[i] = scale[c] * way;
        }
    }
    for (int i = 0; i < OUT; ++i) node.decay[i] = P::decay(node.u[i]);
};
auto mass_between = [&](const Node& a, const Node& b, int k) -> W {
    return P::wide(F(0.5) * (a.v[k] + b.v[k]) * (b.t - a.t));
};
// What output i is integrated by: length, or for a point light the integral of 1 / r^2.
auto measure = [&](const Node& a, const Node& b, int i) -> V {
    const int beam = i / C - 1;
    if (i >= C && IS_POINT[beam])
        return Point::subtended(ray.foot[beam], ray.across[beam], a.t, b.t);
    return b.t - a.t;
};
"""


def packet_kernel(
    name: str,
    layout: Layout,
    case: Case,
    walk: str,
    given: str,
    made: str,
    has_slopes: bool = True,
    changes: bool = False,
) -> TextKernel:
    """The kernel `name` of `walk` along a packet of rays; `given` besides `GIVEN`.

    `made` names what of that it writes. It `has_slopes` of p at nodes, which the integral itself
    does not need. With `changes` it is given `all_fields`: `fields`, from which it samples, and
    their changes.
    """
    optics = DECAYS + POLYNOMIALS + CUBICS + POINTS + RUNGS
    structs = PLACES + VALUES + RUNS + ROWS + WINDOWS + optics + _RECORDS
    chosen = "const F* const* fields = all_fields;" if changes else ""
    constants = layout_constants(layout, case, has_slopes)
    text = constants + structs + chosen + WALKS + ROW_OF + _BEGIN + SEE + _EMIT + walk
    fields = f"all_fields[{2 * layout.channels}]" if changes else f"fields[{layout.channels}]"
    declared = f"{GIVEN} F *{fields}; {given}"
    return TextKernel(name, layout.bits, PACKETS + text, declared, made)
