"""The walk along packets of rays that finds the change of their integral.

With those of fields, numbers, polynomials and the table of p, of the rays themselves, and of the
angles at which they see point lights. A node
and its change are two records of the same kind: that of the change has changes for distances,
values, emission and depth.
"""

from __future__ import annotations

import functools

from ddrecon.kernels.text import TextKernel
from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.packet_layout import Case
from ddrecon.march.fused.packet_rays import packet_kernel
from ddrecon.march.fused.packet_slopes import MOVE_TANGENT, SLOPES, STAY_TANGENT

_WALK = """
const F *d_scale = d_numbers, *d_peaks = d_numbers + C;
const F d_bound = d_numbers[2 * C];
V d_coefficients_of[BEAMS * RAY_TERMS + 1];
const bool turns = HAS_NUMBERS && d_coefficients;
if ((HAS_PEAK || HAS_NUMBERS) && d_coefficients)
    for (int k = 0; k < BEAMS * RAY_TERMS; ++k)
        d_coefficients_of[k] = P::load(d_coefficients + row_of(k), begin, 1, last);
V d_foot[BEAMS + 1], d_across[BEAMS + 1];
for (int b = 0; b < BEAMS; ++b) {
    d_foot[b] = d_angles ? P::load(d_angles + row_of(b), begin, 1, last) : none;
    d_across[b] = d_angles ? P::load(d_angles + row_of(BEAMS + b), begin, 1, last) : none;
}
// The change of what output i is integrated by.
auto change_measure = [&](const Node& a, const Node& b, const Node& d_a, const Node& d_b, int i) {
    const int beam = i / C - 1;
    if (i < C || !IS_POINT[beam]) return d_b.t - d_a.t;
    const Point::Slopes slopes
        = Point::subtended_slopes(ray.foot[beam], ray.across[beam], a.t, b.t);
    return slopes.foot * d_foot[beam] + slopes.across * d_across[beam] + slopes.t0 * d_a.t
         + slopes.t1 * d_b.t;
};
auto sample_change = [&](Node& change, int n, int from, int to) {
    fields = all_fields + CHANNELS;
    sample(change, n, from, to);
    fields = all_fields;
    move_values(change, n, from, to);
};
// The change of the matter at node n, where that is known: the same place.
auto locate_change = [&](int n, Node& node, Node& change) {
    (Spot&)change = node;
    move_node(n, node, change);
    sample_change(change, n, 0, EXTINCTION);
    if (SCATTERING) sample_change(change, n, FIRST_OWN_SCATTERING, FIRST_PEAK);
    for (int c = 0; c < EXTINCTION; ++c)
        node.is_empty = node.is_empty && P::every(change.v[c] == none);
    for (int c = FIRST_OWN_SCATTERING; c < FIRST_PEAK; ++c)
        node.is_empty = node.is_empty && P::every(change.v[c] == none);
};
// The changes of p's coefficients themselves, if they change: by rays, or by tables.
auto changing_curve = [&](const Node& node, int b, int c, V* d_curve) -> const V* {
    if (!IS_POINT[b] && !HAS_RUNGS)
        return d_coefficients ? d_coefficients_of + first_of(b, c) : nullptr;
    if (!d_table) return nullptr;
    if (HAS_RUNGS) {
        V cosine;
        const Cubic angle = angle_of(node, b, cosine);
        const V place = Rungs::place(number_of(node, c * PHASE_STEP));
        const Cubic rung = Cubic::at(place, LAST_RUNG);
        const F* const changes_of_table = d_table + c * PHASE_STEP * TABLE_STEP;
        Rungs::read(changes_of_table, rung, angle, d_curve, nullptr, nullptr);
    } else {
        Point::curve(node.point[b], d_table + c * PHASE_STEP * TABLE_STEP, d_curve);
    }
    return d_curve;
};
// The change of p on the way `way` to the light, of which the depth of its peak changes.
auto change_of_p = [&](const Node& node, const Node& change, int b, int c, V way, V d_depth) -> V {
    const int phase = b * PHASES + c * PHASE_STEP;
    const V d_number = HAS_NUMBERS ? change.v[FIRST_NUMBER + c * NUMBER_STEP] : none;
    V d_p = none, d_plain = none, d_turn = none, d_cosine = none;
    if (VARIES_ANGLES && IS_POINT[b]) {
        const Point::Turning turning = turning_of(node, b);
        d_turn = turning.along * (d_foot[b] + change.t) + turning.across * d_across[b];
        d_cosine = turning.cosine * d_turn;
    }
    if (has_curve(b)) {
        V d_curve[TERMS];
        const V place = place_of(node, c, way), *curve = curve_of(node, b, c);
        const V* d_terms = changing_curve(node, b, c, d_curve);
        if (d_terms) d_p = Polynomial::at(d_terms, place);
        if (HAS_PEAK) d_p += d_depth * Polynomial::slope(curve, place);
        if (IS_LINEAR) d_p += d_number * curve[TERMS - 1];
        if (HAS_RUNGS) d_p += d_number * Polynomial::at(node.by_number + phase * TERMS, place);
        if (VARIES_ANGLES && IS_POINT[b]) d_p += d_turn * by_turn(node, b, c, place);
        if (HAS_RUNGS && turns && !IS_POINT[b])
            d_p += d_coefficients_of[b * RAY_TERMS + 2]
                 * Polynomial::at(node.by_angle + phase * TERMS, place);
        if (HAS_PEAK) d_p = P::pick(node.p[(1 + b) * C + c] > none, d_p, none);
    }
    if (!IS_STEEP) return d_p;
    d_plain = node.plain[phase].by_g * d_number;
    if (turns && !IS_POINT[b])
        d_plain += node.plain[phase].by_cosine * d_coefficients_of[b * RAY_TERMS];
    if (VARIES_ANGLES && IS_POINT[b]) d_plain += node.plain[phase].by_cosine * d_cosine;
    return HAS_PEAK ? P::pick(is_peaked(node, c), d_p, d_plain) : d_plain;
};
// The change of all else at node n, behind the mass `m` and its change.
auto emit_change = [&](int n, Node& node, Node& change, const W* m, const V* d_m) {
    sample_change(change, n, EXTINCTION, FIRST_OWN_SCATTERING);
    if (FIRST_PEAK < CHANNELS) sample_change(change, n, FIRST_PEAK, CHANNELS);
    for (int k = 0; k < MASSES; ++k) {
        const V bend = node.bend[k], bent = bound * bend;
        const V inverse = F(1) / P::root(F(1) + bent * bent);
        change.v[FIRST_MASS + k] -= inverse * inverse * inverse
            * (change.bend[k] - bent * bend * bend * d_bound);
    }
    for (int c = 0; c < C; ++c) {
        const int s = FIRST_DIFFUSING + c * DIFFUSING_STEP, k = c * MASS_STEP;
        const int d = FIRST_DIFFUSE + c * DIFFUSE_STEP;
        change.w[c] = change.v[s] * node.v[d] + node.v[s] * change.v[d];
        change.u[c] = scale[c] * d_m[k] + d_scale[c] * P::narrow(m[k]);
    }
    for (int b = 0; b < BEAMS; ++b) {
        for (int c = 0; c < C; ++c) {
            const int i = C + b * C + c, k = c * MASS_STEP, j = FIRST_MASS + b * EXTINCTION + k;
            const int s = FIRST_SCATTERING + c * SCATTERING_STEP;
            const V way = P::narrow(m[k]) + node.v[j], d_way = d_m[k] + change.v[j];
            V d_depth = none;
            if (HAS_PEAK) {
                const V peak = peak_of(node, c);
                const V d_peak = IS_PEAK_FIELD ? change.v[FIRST_PEAK + c * PEAK_STEP]
                                               : P::all(d_peaks[c]);
                d_depth = peak * d_way + d_peak * way;
            }
            const V d_p = change_of_p(node, change, b, c, way, d_depth);
            change.w[i] = change.v[s] * node.p[i] + node.v[s] * d_p;
            change.u[i] = scale[c] * d_way + d_scale[c] * way;
        }
    }
};
V total[OUT], d_m[EXTINCTION];
W m[EXTINCTION];
for (int i = 0; i < OUT; ++i) total[i] = none;
for (int k = 0; k < EXTINCTION; ++k) {
    d_m[k] = front_of(d_fronts, k);
    m[k] = P::wide(front_of(fronts, k));
}
Node nodes[2], changes[2];
Node *a = nodes, *b = nodes + 1, *d_a = changes, *d_b = changes + 1;
for (int from, to = first_node; next_stretch(from, to);) {
    locate(from, *a);
    locate_change(from, *a, *d_a);
    a->is_lit = false;
    for (int n = from + 1; n <= to; ++n) {
        locate(n, *b);
        locate_change(n, *b, *d_b);
        b->is_lit = !(a->is_empty && b->is_empty);
        if (b->is_lit) {
            if (!a->is_lit) {
                emit(n - 1, *a, m, turns);
                emit_change(n - 1, *a, *d_a, m, d_m);
            }
            // The mass passed on the way to the next node, and what it emits behind that.
            for (int k = 0; k < EXTINCTION; ++k) {
                m[k] += mass_between(*a, *b, k);
                d_m[k] += F(0.5) * (d_a->v[k] + d_b->v[k]) * (b->t - a->t);
                if (VARIES_RAYS) d_m[k] += F(0.5) * (a->v[k] + b->v[k]) * (d_b->t - d_a->t);
            }
            emit(n, *b, m, turns);
            emit_change(n, *b, *d_b, m, d_m);
            // E2, E3: what arrives from the segment between both.
            for (int i = 0; i < OUT; ++i) {
                V by_a, by_b;
                const V decay
                    = Decay::slopes(a->u[i], b->u[i], a->decay[i], b->decay[i], by_a, by_b);
                const V brighter = (d_a->w[i] + d_b->w[i]) * decay;
                const V deeper = (a->w[i] + b->w[i]) * (by_a * d_a->u[i] + by_b * d_b->u[i]);
                total[i] += F(0.5) * measure(*a, *b, i) * (brighter + deeper);
                if (VARIES_RAYS || VARIES_ANGLES)
                    total[i] += F(0.5) * (a->w[i] + b->w[i]) * decay
                              * change_measure(*a, *b, *d_a, *d_b, i);
            }
        }
        Node *passed = a, *d_passed = d_a;
        a = b, d_a = d_b;
        b = passed, d_b = d_passed;
    }
}
for (int l = 0; l < LANES && begin + l <= last; ++l) {
    for (int i = 0; i < OUT; ++i)
        d_out[row_of(i) + begin + l] = P::lane(total[i], l);
    for (int k = 0; k < EXTINCTION; ++k)
        d_masses[row_of(k) + begin + l] = P::lane(d_m[k], l);
}
"""


@functools.cache
def packet_tangent_kernel(layout: Layout, case: Case) -> TextKernel:
    """The kernel of the changes `d_out` [outputs, R] and `d_masses` [K, R] of packets of rays.

    `d_angles`, `d_coefficients`, `d_table` and `d_fronts`, as what they are changes of, may be left
    out. Where it `varies_rays` it is given their changes, `d_rays` [R, 8].
    """
    given = """
    F *d_angles, *d_coefficients, *d_numbers, *d_table, *d_fronts, *d_out, *d_masses, *d_rays
    """
    moving = SLOPES + MOVE_TANGENT if case.varies_rays else STAY_TANGENT
    text, made = moving + _WALK, "d_out d_masses"
    return packet_kernel("integrate_tangent", layout, case, text, given, made, changes=True)
