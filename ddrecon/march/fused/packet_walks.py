"""The walks along packets of rays: the integral, from the camera into the volume, and its adjoint.

Of the walk out nothing is kept but the mass behind each ray: on the walk back values are sampled
anew, and masses are those behind less those of the segments in between.
"""

from __future__ import annotations

import functools

from ddrecon.kernels.text import TextKernel
from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.packet_layout import Case
from ddrecon.march.fused.packet_rays import packet_kernel
from ddrecon.march.fused.packet_slopes import MOVE, SLOPES, STAY
from ddrecon.march.fused.packet_spread import SPREAD

_INTEGRATE = """
V total[OUT];
W m[EXTINCTION];
for (int i = 0; i < OUT; ++i) total[i] = P::all(F(0));
for (int k = 0; k < EXTINCTION; ++k) m[k] = P::wide(front_of(fronts, k));
Node nodes[2];
Node* a = nodes;
Node* b = nodes + 1;
for (int from, to = first_node; next_stretch(from, to);) {
    locate(from, *a);
    a->is_lit = false;
    for (int n = from + 1; n <= to; ++n) {
        locate(n, *b);
        b->is_lit = !(a->is_empty && b->is_empty);
        // Between empty nodes nothing is added: what light there is does not matter.
        if (b->is_lit) {
            if (!a->is_lit) emit(n - 1, *a, m);
            // The mass passed on the way to the next node, and what it emits behind that.
            for (int k = 0; k < EXTINCTION; ++k) m[k] += mass_between(*a, *b, k);
            emit(n, *b, m);
            // E2, E3: what arrives from the segment between both.
            for (int i = 0; i < OUT; ++i) {
                const V decay = Decay::mean(a->u[i], b->u[i], a->decay[i], b->decay[i]);
                total[i] += F(0.5) * (a->w[i] + b->w[i]) * measure(*a, *b, i) * decay;
            }
        }
        Node* passed = a;
        a = b;
        b = passed;
    }
}
for (int l = 0; l < LANES && begin + l <= last; ++l) {
    for (int i = 0; i < OUT; ++i)
        out[row_of(i) + begin + l] = P::lane(total[i], l);
    for (int k = 0; k < EXTINCTION; ++k)
        masses[row_of(k) + begin + l] = P::lane_of(m[k], l);
}
"""
_TRANSPOSE = """
V inside = none;
for (int l = 0; l < LANES && begin + l <= last; ++l) P::put(inside, l, F(1));
V bar[OUT], m_bar[EXTINCTION], scale_bar[C], peak_bar[C], bound_bar = none;
V polynomial_bar[BEAMS * RAY_TERMS + 1];
const bool varies_polynomials = polynomials_bar;
V foot_bar[BEAMS + 1], across_bar[BEAMS + 1];
for (int b = 0; b < BEAMS; ++b) foot_bar[b] = across_bar[b] = none;
bool is_asked = false;
for (int i = 0; i < OUT; ++i) {
    bar[i] = inside * P::load(out_bar + row_of(i), begin, 1, last);
    is_asked = is_asked || !P::every(bar[i] == none);
}
W m[EXTINCTION];
for (int k = 0; k < EXTINCTION; ++k) {
    m_bar[k] = inside * P::load(masses_bar + row_of(k), begin, 1, last);
    m[k] = P::load_wide(masses + row_of(k), begin, last);
    is_asked = is_asked || !P::every(m_bar[k] == none);
}
// Pixels that nothing is asked of, masked ones for instance, need no walk.
if (!is_asked) last_node = first_node;
for (int c = 0; c < C; ++c) scale_bar[c] = peak_bar[c] = none;
for (int k = 0; k < BEAMS * RAY_TERMS; ++k) polynomial_bar[k] = none;
// Of p in tables by number and angle, the bars of both.
auto finish_rungs = [&](const Node& node, int b, int c, V p_bar, V place, V* v_bar) {
    const int first = (b * PHASES + c * PHASE_STEP) * TERMS;
    v_bar[FIRST_NUMBER + c * NUMBER_STEP] += p_bar * Polynomial::at(node.by_number + first, place);
    if (!IS_POINT[b] && varies_polynomials)
        polynomial_bar[b * RAY_TERMS + 2] += p_bar * Polynomial::at(node.by_angle + first, place);
};
auto spread_to_rungs = [&](const Node& node, int b, int c, const V* curve_bar) {
    V cosine;
    const Cubic angle = angle_of(node, b, cosine);
    const V place = Rungs::place(number_of(node, c * PHASE_STEP));
    F* const bar = table_bar + c * PHASE_STEP * TABLE_STEP;
    Rungs::spread(bar, Cubic::at(place, LAST_RUNG), angle, curve_bar);
};
// What node b emits, and its values go back to the cells. Its mass is that behind it, `m_b`.
auto finish = [&](int n, const Node& node, const W* m_b, V* v_bar, const V* w_bar, const V* u_bar,
                  V* m_bar, V& t_bar) {
    for (int c = 0; c < C; ++c) {
        const int k = c * MASS_STEP, s = FIRST_DIFFUSING + c * DIFFUSING_STEP;
        const int d = FIRST_DIFFUSE + c * DIFFUSE_STEP;
        const V mass = P::narrow(m_b[k]), scattering = node.v[s];
        v_bar[s] += w_bar[c] * node.v[d];
        v_bar[d] += w_bar[c] * scattering;
        m_bar[k] += u_bar[c] * scale[c];
        scale_bar[c] += u_bar[c] * mass;
    }
    for (int b = 0; b < BEAMS; ++b) {
        for (int c = 0; c < C; ++c) {
            const int k = c * MASS_STEP, s = FIRST_SCATTERING + c * SCATTERING_STEP;
            const V mass = P::narrow(m_b[k]), scattering = node.v[s];
            const int i = C + b * C + c, j = FIRST_MASS + b * EXTINCTION + k;
            const V way = mass + node.v[j];
            V way_bar = u_bar[i] * scale[c];
            scale_bar[c] += u_bar[i] * way;
            v_bar[s] += w_bar[i] * node.p[i];
            const V p_bar = w_bar[i] * scattering;
            V depth_bar = none, turn_bar = none;
            // What scatters nothing has no phase function to vary.
            if (has_curve(b) && !node.is_empty) {
                const V place = place_of(node, c, way), *curve = curve_of(node, b, c);
                const M counts = (node.p[i] > none) & is_peaked(node, c);
                V power = HAS_PEAK ? P::pick(counts, p_bar, none) : p_bar;
                if (HAS_PEAK) depth_bar = power * Polynomial::slope(curve, place);
                if (IS_LINEAR) v_bar[FIRST_NUMBER + c * NUMBER_STEP] += power * curve[TERMS - 1];
                if (HAS_RUNGS) finish_rungs(node, b, c, power, place, v_bar);
                if (VARIES_ANGLES && IS_POINT[b]) turn_bar = power * by_turn(node, b, c, place);
                V powers[TERMS];
                for (int k = 0; k < TERMS; ++k) {
                    powers[k] = power;
                    power *= place;
                }
                if (HAS_RUNGS && table_bar) spread_to_rungs(node, b, c, powers);
                if (!HAS_RUNGS && IS_POINT[b] && table_bar)
                    Point::spread(node.point[b], table_bar + c * PHASE_STEP * TABLE_STEP, powers);
                if (!HAS_RUNGS && !IS_POINT[b] && varies_polynomials)
                    for (int k = 0; k < TERMS; ++k)
                        polynomial_bar[first_of(b, c) + k] += powers[k];
            }
            if (IS_STEEP) {
                const Plain& plain = node.plain[b * PHASES + c * PHASE_STEP];
                const V plain_bar = HAS_PEAK ? P::pick(is_peaked(node, c), none, p_bar) : p_bar;
                v_bar[FIRST_NUMBER + c * NUMBER_STEP] += plain_bar * plain.by_g;
                if (!IS_POINT[b] && varies_polynomials)
                    polynomial_bar[b * RAY_TERMS] += plain_bar * plain.by_cosine;
                if (VARIES_ANGLES && IS_POINT[b])
                    turn_bar += plain_bar * plain.by_cosine * turning_of(node, b).cosine;
            }
            if (VARIES_ANGLES && IS_POINT[b]) {
                const Point::Turning turning = turning_of(node, b);
                foot_bar[b] += turn_bar * turning.along;
                across_bar[b] += turn_bar * turning.across;
                t_bar += turn_bar * turning.along;
            }
            if (HAS_PEAK) {
                way_bar += depth_bar * peak_of(node, c);
                if (IS_PEAK_FIELD) v_bar[FIRST_PEAK + c * PEAK_STEP] += depth_bar * way;
                else peak_bar[c] += depth_bar * way;
            }
            m_bar[k] += way_bar;
            v_bar[j] += way_bar;
        }
    }
};
auto spread = [&](int n, const Node& node, const V* v_bar, V t_bar) {
    V bend_bar[MASSES + 1];
    for (int k = 0; k < MASSES; ++k) {
        const V bent = bound * node.bend[k], inverse = node.held[k];
        bend_bar[k] = -v_bar[FIRST_MASS + k] * inverse * inverse * inverse;
        bound_bar -= bend_bar[k] * bent * node.bend[k] * node.bend[k];
    }
    if (IS_SLICED) spread_to_cells(node, slice(n), v_bar, bend_bar);
    else spread_between(node, v_bar, bend_bar);
    move(n, node, v_bar, bend_bar, t_bar);
};
Node nodes[2];
Node* a = nodes;
Node* b = nodes + 1;
V a_bar[CHANNELS], b_bar[CHANNELS], wa_bar[OUT], wb_bar[OUT], ua_bar[OUT], ub_bar[OUT];
V ta_bar, tb_bar;
for (int from = last_node, to; stretch_before(from, to);) {
    for (int c = 0; c < CHANNELS; ++c) b_bar[c] = none;
    for (int i = 0; i < OUT; ++i) wb_bar[i] = ub_bar[i] = none;
    tb_bar = none;
    locate(to, *b);
    emit(to, *b, m, varies_polynomials);
    // Node b lies behind node a. Its bars grow by the segments on both sides, then it is done.
    for (int n = to - 1; n >= from; --n) {
        W m_b[EXTINCTION];
        locate(n, *a);
        for (int k = 0; k < EXTINCTION; ++k) {
            m_b[k] = m[k];
            m[k] -= mass_between(*a, *b, k);
        }
        emit(n, *a, m, varies_polynomials);
        const bool is_empty = a->is_empty && b->is_empty;
        V length_bar = none, begin_bar = none, end_bar = none;
        for (int i = 0; i < OUT; ++i) {
            V by_a = none, by_b = none;
            const V decay = is_empty
                ? Decay::mean(a->u[i], b->u[i], a->decay[i], b->decay[i])
                : Decay::slopes(a->u[i], b->u[i], a->decay[i], b->decay[i], by_a, by_b);
            const V half = F(0.5) * bar[i] * measure(*a, *b, i);
            const V both = half * (a->w[i] + b->w[i]);
            wa_bar[i] = half * decay;
            wb_bar[i] += wa_bar[i];
            ua_bar[i] = both * by_a;
            ub_bar[i] += both * by_b;
            const int beam = i / C - 1;
            if (VARIES_ANGLES && i >= C && IS_POINT[beam]) {
                const V by = F(0.5) * bar[i] * (a->w[i] + b->w[i]) * decay;
                const Point::Slopes slopes = Point::subtended_slopes(
                    ray.foot[beam], ray.across[beam], a->t, b->t);
                foot_bar[beam] += by * slopes.foot;
                across_bar[beam] += by * slopes.across;
                begin_bar += by * slopes.t0;
                end_bar += by * slopes.t1;
            } else if (VARIES_RAYS) {
                length_bar += F(0.5) * bar[i] * (a->w[i] + b->w[i]) * decay;
            }
        }
        if (VARIES_ANGLES) tb_bar += end_bar;
        finish(n + 1, *b, m_b, b_bar, wb_bar, ub_bar, m_bar, tb_bar);
        // Its mass is that of node a and half the sum of extinctions, by the length.
        for (int c = 0; c < CHANNELS; ++c) a_bar[c] = none;
        for (int k = 0; k < EXTINCTION; ++k) {
            a_bar[k] = F(0.5) * m_bar[k] * (b->t - a->t);
            b_bar[k] += a_bar[k];
            if (VARIES_RAYS) length_bar += F(0.5) * m_bar[k] * (a->v[k] + b->v[k]);
        }
        ta_bar = -length_bar;
        if (VARIES_ANGLES) ta_bar += begin_bar;
        spread(n + 1, *b, b_bar, tb_bar + length_bar);
        tb_bar = ta_bar;
        for (int c = 0; c < CHANNELS; ++c) b_bar[c] = a_bar[c];
        for (int i = 0; i < OUT; ++i) {
            wb_bar[i] = wa_bar[i];
            ub_bar[i] = ua_bar[i];
        }
        Node* passed = b;
        b = a;
        a = passed;
    }
    finish(from, *b, m, b_bar, wb_bar, ub_bar, m_bar, tb_bar);
    spread(from, *b, b_bar, tb_bar);
}
for (int c = 0; c < C; ++c) {
    numbers_bar[c * packets + item] = P::sum(scale_bar[c]);
    numbers_bar[(C + c) * packets + item] = P::sum(peak_bar[c]);
}
numbers_bar[2 * C * packets + item] = P::sum(bound_bar);
store_ray();
if (angles_bar)
    for (int b = 0; b < BEAMS; ++b)
        for (int l = 0; l < LANES && begin + l <= last; ++l) {
            angles_bar[row_of(b) + begin + l] = P::lane(foot_bar[b], l);
            angles_bar[row_of(BEAMS + b) + begin + l] = P::lane(across_bar[b], l);
        }
if (fronts_bar)
    for (int k = 0; k < EXTINCTION; ++k)
        for (int l = 0; l < LANES && begin + l <= last; ++l)
            fronts_bar[row_of(k) + begin + l] = P::lane(m_bar[k], l);
if (varies_polynomials)
    for (int k = 0; k < BEAMS * RAY_TERMS; ++k)
        for (int l = 0; l < LANES && begin + l <= last; ++l)
            polynomials_bar[row_of(k) + begin + l] =
                P::lane(polynomial_bar[k], l);
"""


@functools.cache
def packet_integral_kernel(layout: Layout, is_sliced: bool) -> TextKernel:
    """The kernel of E1 to E3 along packets of rays: `out` [outputs, R] and `masses` [K, R]."""
    given = "F *out; double *masses"
    return packet_kernel(
        "integrate", layout, Case(is_sliced), _INTEGRATE, given, "out masses", False
    )


@functools.cache
def packet_adjoint_kernel(layout: Layout, case: Case) -> TextKernel:
    """The kernel that adds to `bars`, of `fields`, what bars of outputs and masses are for them.

    These are left out where none are asked for. Each packet has its own `numbers_bar`
    [2 C + 1, packets]; `polynomials_bar`, `table_bar` and, if it `varies_angles`, `angles_bar`, as
    what they are of, may be left out. Where it `varies_rays` there are `rays_bar` [R, 8] as well.
    """
    given = f"""
    double *masses, *numbers_bar; int packets;
    F *out_bar, *masses_bar, *polynomials_bar, *table_bar, *fronts_bar, *bars[{layout.channels}];
    F *rays_bar, *angles_bar
    """
    moving = SLOPES + MOVE if case.varies_rays else STAY
    made = "numbers_bar polynomials_bar table_bar fronts_bar bars rays_bar angles_bar"
    return packet_kernel("transpose", layout, case, SPREAD + moving + _TRANSPOSE, given, made)
