#pragma once
#include "ddrecon/march/fused/rays.h"
// The adjoint of the walk along packets of rays. Of the walk out nothing is kept but the mass
// behind each ray: on the walk back values are sampled anew, and masses are those behind less those
// of the segments in between.

namespace ddrecon {

// Cotangents of what the walk found, with the masses that it found, and of its arguments: those
// that are null are not asked for. Each packet has its own `numbers` [2 C + 1, packets]. On a GPU
// `bounds` [CHANNELS + 1] are those of sums, the table's last; where these are asked for, all else
// is not, and each packet has its own `most` [CHANNELS + 1, packets] of them.
template <class F> struct Cotangents {
    const F *out, *masses;
    const double *mass, *bounds;
    double *most, *numbers;
    F *rays, *angles, *fronts;
    Sum<F>* table;
    Sum<F>* const* fields;
    int packets;
};

template <class F, class L, class Which> struct Back : Rays<F, L, Which, ADJOINT> {
    typedef ddrecon::Rays<F, L, Which, ADJOINT> Rays;
    typedef typename Rays::P P;
    typedef typename Rays::V V;
    typedef typename Rays::W W;
    typedef typename Rays::E E;
    typedef typename Rays::Table Table;
    using Rays::begin, Rays::last, Rays::foot, Rays::across, Rays::row_of, Rays::ray, Rays::lines;
    using Rays::COSINE, Rays::DEPTH, Rays::NUMBER, Rays::PLACE, Rays::TURNS;
    using Which::IS_SLICED, Which::MOVES, Which::VARIES_TABLES;

    // With the mass behind it, and the bars of its values, emission, depth and distance.
    struct Node : Rays::Node {
        W m[L::EXTINCTION];
        V v_bar[L::CHANNELS], w_bar[L::OUT], u_bar[L::OUT], t_bar;
    };

    const Cotangents<F>& bars;
    const V zero = P::all(F(0)), one = P::all(F(1));
    V m_bar[L::EXTINCTION], number_bar[2 * L::C + 1],
        curve_bar[VARIES_TABLES * L::HOLDS * L::BEAMS * L::HELD + 1];
    V foot_bar[L::BEAMS + 1], across_bar[L::BEAMS + 1];
    V ray_bar[8] = {zero, zero, zero, zero, zero, zero, zero, zero};
#if IS_GPU
    // What shares come to at most; or, once that is known of all packets, their scales.
    F sizes[L::CHANNELS + 1];
#endif

    Back(int item, const Arguments<F>& arguments, const Cotangents<F>& bars)
        : Rays(item, arguments, {}), bars(bars) {}
    void run() {
        V bar[L::OUT], inside = zero;
        W m[L::EXTINCTION];
        for (int l = 0; l < LANES && begin + l <= last; ++l) P::put(inside, l, F(1));
        bool is_asked = false;
        for (int i = 0; i < L::OUT; ++i) {
            bar[i] = inside * bar_of(bars.out, i);
            is_asked = is_asked || !this->is_nothing(bar[i]);
        }
        for (int k = 0; k < L::EXTINCTION; ++k) {
            m_bar[k] = inside * bar_of(bars.masses, k);
            m[k] = P::load_wide(bars.mass + row_of(k), begin, last);
            is_asked = is_asked || !this->is_nothing(m_bar[k]);
        }
#if IS_GPU
        for (int c = 0; c <= L::CHANNELS; ++c)
            sizes[c] = bars.most ? F(0) : scale_of<F>(bars.bounds[c]);
#endif
        for (V& bar : number_bar) bar = zero;
        for (V& bar : curve_bar) bar = zero;
        for (int b = 0; b < L::BEAMS; ++b) foot_bar[b] = across_bar[b] = zero;
        // Pixels that nothing is asked of, masked ones for instance, need no walk.
        if (is_asked) walk(bar, m);
        store();
    }

    // Row k of an array that has a number of each ray, if any.
    V bar_of(const F* array, int k) const {
        return array ? P::load(array + row_of(k), begin, 1, last) : zero;
    }

    // Node b lies behind node a. Its bars grow by the segments on both sides, then it is done.
    void walk(const V* bar, W* m) {
        Node nodes[2], *a = nodes, *b = nodes + 1;
        for (int from = this->last_node, to; this->stretch_before(from, to);) {
            this->locate(to, *b);
            reach(*b, m);
            for (int n = to - 1; n >= from; --n) {
                this->locate(n, *a);
                for (int k = 0; k < L::EXTINCTION; ++k) m[k] -= this->mass_between(*a, *b, k);
                reach(*a, m);
                for (int i = 0; i < L::OUT; ++i) {
                    const Decay<F> decay(a->u[i], b->u[i], a->decay[i], b->decay[i]);
                    const V half = F(0.5) * bar[i], sum = a->w[i] + b->w[i];
                    const V measured = half * this->measure(*a, *b, i);
                    a->w_bar[i] = measured * decay.mean;
                    b->w_bar[i] += a->w_bar[i];
                    a->u_bar[i] = measured * sum * decay.by0;
                    b->u_bar[i] += measured * sum * decay.by1;
                    if (MOVES) stretch(half * sum * decay.mean, i, *a, *b);
                }
                finish(*b);
                // Its mass is that of node a and half the sum of extinctions, by the length.
                for (int k = 0; k < L::EXTINCTION; ++k) {
                    const V half = F(0.5) * m_bar[k];
                    a->v_bar[k] = half * (b->t - a->t);
                    b->v_bar[k] += a->v_bar[k];
                    if (MOVES) lengthen(half * (a->v[k] + b->v[k]), *a, *b);
                }
                spread(*b);
                swap(a, b);
            }
            finish(*b);
            spread(*b);
        }
    }
    // A node with the mass `m` behind it, of which nothing is known yet.
    void reach(Node& node, const W* m) const {
        this->emit(node, m);
        for (int k = 0; k < L::EXTINCTION; ++k) node.m[k] = m[k];
        for (V& bar : node.v_bar) bar = zero;
        for (int i = 0; i < L::OUT; ++i) node.w_bar[i] = node.u_bar[i] = zero;
        node.t_bar = zero;
    }
    // What bars of the length between nodes, and of what output i is integrated by, are for them.
    static void lengthen(V bar, Node& a, Node& b) {
        a.t_bar -= bar;
        b.t_bar += bar;
    }
    void stretch(V bar, int i, Node& a, Node& b) {
        const int beam = i / L::C - 1;
        if (i < L::C || !L::is_point(beam)) return lengthen(bar, a, b);
        Dual<V, 4> x[] = {foot[beam], across[beam], a.t, b.t};
        for (int k = 0; k < 4; ++k) x[k].by[k] = one;
        const auto angle = Point<F>::subtended(x[0], x[1], x[2], x[3]);
        foot_bar[beam] += bar * angle.by[0];
        across_bar[beam] += bar * angle.by[1];
        a.t_bar += bar * angle.by[2];
        b.t_bar += bar * angle.by[3];
    }

    // What a node emits goes back to its values.
    void finish(Node& node) {
        for (int c = 0; c < L::C; ++c) {
            const int k = L::extinction(c), s = L::diffusing(c), d = L::diffuse(c);
            node.v_bar[s] += node.w_bar[c] * node.v[d];
            node.v_bar[d] += node.w_bar[c] * node.v[s];
            if constexpr (L::EMITTED > 0) node.v_bar[L::emitted(c)] += node.w_bar[c];
            m_bar[k] += node.u_bar[c] * this->number(c);
            number_bar[c] += node.u_bar[c] * P::narrow(node.m[k]);
        }
        for (int b = 0; b < L::BEAMS; ++b) {
            V place_bar = zero, cosine_bar = zero;
            for (int c = 0; c < L::C; ++c) {
                const int k = L::extinction(c), s = L::scattering(c);
                const int i = L::C + b * L::C + c, j = L::mass(b, c);
                const V passed = P::narrow(node.m[k]) + node.v[j];
                const V p_bar = node.w_bar[i] * node.v[s];
                V passed_bar = node.u_bar[i] * this->number(c);
                number_bar[c] += node.u_bar[i] * passed;
                node.v_bar[s] += node.w_bar[i] * node.p[i].value;
                // What scatters nothing has no phase function to vary.
                if (!node.is_empty) {
                    const E& p = node.p[i];
                    if constexpr (L::HAS_PEAK) {
                        const V depth_bar = p_bar * p.by[DEPTH];
                        passed_bar += depth_bar * this->peak_of(node, c);
                        V& peak_bar =
                            L::IS_PEAK_FIELD ? node.v_bar[L::peak(c)] : number_bar[L::C + c];
                        peak_bar += depth_bar * passed;
                    }
                    if constexpr (L::HAS_NUMBERS)
                        node.v_bar[L::FIRST_NUMBER + L::number(c)] += p_bar * p.by[NUMBER];
                    if constexpr (TURNS) place_bar += p_bar * p.by[PLACE];
                    if constexpr (TURNS && L::IS_SCALED) cosine_bar += p_bar * p.by[COSINE];
                    if constexpr (VARIES_TABLES)
                        if (L::has_curve(b)) finish_curve(node, b, c, passed, p_bar);
                }
                m_bar[k] += passed_bar;
                node.v_bar[j] += passed_bar;
            }
            if (TURNS) finish_angles(node, b, place_bar, cosine_bar);
        }
    }
    // What p of beam b in color c had of the coefficients in its table.
    void finish_curve(const Node& node, int b, int c, V passed, V p_bar) {
        const int table = L::table(c);
        const bool is_held = L::HOLDS && !L::is_point(b);
        V number = zero, cosine, bars_at_node[L::CURVE] = {};
        if (L::HAS_NUMBERS)
            number = number_place<F, L::IS_SCALED>(node.v[L::FIRST_NUMBER + L::number(c)]);
        if (L::HAS_PEAK) p_bar = P::pick(node.p[L::C + b * L::C + c].value > zero, p_bar, zero);
        V* const bar = is_held ? curve_bar + b * L::HELD + table * L::CURVE : bars_at_node;
        const V depth = L::HAS_PEAK ? value_of(this->peak_of(node, c)) * passed : zero;
        Polynomials<F, L::TERMS, L::POWERS>::spread(p_bar, depth, number, bar);
        if (is_held) return;
        spread_table(this->see(b, foot[b], across[b], node.t, cosine), table, bar);
    }
    void spread_table(const Cubic<F, V>& place, int table, V* bar) {
        if (weighs(L::CHANNELS, L::CURVE, bar))
            Table::spread(place, bars.table + table * Table::SIZE, bar);
    }
    // Whether shares `bar` of sums from c on, whose scales are known, are to be added; if not, they
    // count for these. No share is more than its bar.
    bool weighs(int c, int count, V* bar) {
#if IS_GPU
        for (int k = 0; k < count; ++k) {
            F& size = sizes[c < L::CHANNELS ? c + k : c];
            if (bars.most)
                size += P::size(bar[k]);
            else
                bar[k] *= size;
        }
        return !bars.most;
#else
        return true;
#endif
    }
    // What bars of beam b's place in tables, and of the cosine there, are for its angles.
    void finish_angles(Node& node, int b, V place_bar, V cosine_bar) {
        Dual<V, 3> x[] = {foot[b], across[b], node.t}, cosine;
        for (int k = 0; k < 3; ++k) x[k].by[k] = one;
        const Dual<V, 3> place = this->see(b, x[0], x[1], x[2], cosine).fraction;
        V* const to[] = {&foot_bar[b], &across_bar[b], &node.t_bar};
        for (int k = 0; k < 3; ++k) *to[k] += place_bar * place.by[k] + cosine_bar * cosine.by[k];
    }

    // The values of a node go back to the cells, and where it lies to its rays.
    void spread(Node& node) {
        V bend_bar[L::MASSES + 1];
        for (int k = 0; k < L::MASSES; ++k) {
            const V off = this->number(2 * L::C) * node.bend[k], inverse = node.limit[k];
            bend_bar[k] = -node.v_bar[L::FIRST_MASS + k] * inverse * inverse * inverse;
            number_bar[2 * L::C] -= bend_bar[k] * off * node.bend[k] * node.bend[k];
        }
        if (MOVES && bars.rays) move(node, bend_bar);
        weighs(L::FIRST_MASS, L::MASSES, bend_bar);
        if (!weighs(0, L::CHANNELS, node.v_bar)) return;
        if constexpr (IS_SLICED)
            spread_in_slice<F, L>(
                bars.fields, this->slice(node.n), node.runs, node.y, node.x, lines, node.v_bar,
                bend_bar);
        else
            spread_between(node, bend_bar);
    }
    void spread_between(const Node& node, const V* bend_bar) const {
        for (int i = 0; i < 4; ++i) {
            if ((i == 0 || i == 3) && !L::MASSES) continue;
            V value_bar[L::CHANNELS], linear_bar[L::MASSES + 1];
            for (int c = 0; c < L::CHANNELS; ++c) value_bar[c] = node.z.linear(i) * node.v_bar[c];
            for (int k = 0; k < L::MASSES; ++k) {
                value_bar[L::FIRST_MASS + k] += node.z.bend(i) * bend_bar[k];
                linear_bar[k] = node.z.linear(i) * bend_bar[k];
            }
            const auto row = node.y.behind(node.z.cells[i] * lines.rows);
            Runs<F> runs;
            runs.find(row, node.x, lines);
            spread_in_slice<F, L>(bars.fields, 0, runs, row, node.x, lines, value_bar, linear_bar);
        }
    }
    void move(const Node& node, const V* bend_bar) {
        // By the places across slices, along y and along x: by those along axes from FIRST on.
        constexpr int FIRST = IS_SLICED;
        typedef Dual<V, 3 - FIRST> Slope;
        Spot<F, IS_SLICED, Slope> spot;
        auto at = [&](int axis, int size) {
            Slope y(this->place(node.s, axis));
            y.by[axis - FIRST] = one;
            return Place<F, Slope>(y, size);
        };
        if constexpr (!IS_SLICED) spot.z = at(0, this->arguments.depth);
        spot.y = at(1, lines.rows);
        spot.x = at(2, lines.columns);
        V at_bar[3] = {zero, zero, zero};
        for (int c = 0; c < L::CHANNELS; ++c) {
            Slope bend(zero);
            const Slope v = spot.value(this->field(c, node.n), lines, L::is_cubic(c), bend);
            for (int axis = FIRST; axis < 3; ++axis) {
                at_bar[axis] += node.v_bar[c] * v.by[axis - FIRST];
                if (L::is_cubic(c))
                    at_bar[axis] += bend_bar[c - L::FIRST_MASS] * bend.by[axis - FIRST];
            }
        }
        // A distance that is clamped is that of a face.
        const auto is_behind = node.s > ray[6], is_before = node.s < ray[7];
        ray_bar[6] += P::pick(is_behind, zero, node.t_bar);
        ray_bar[7] += P::pick(is_before, zero, node.t_bar);
        V s_bar = P::pick(is_behind & is_before, node.t_bar, zero);
        for (int axis = FIRST; axis < 3; ++axis) {
            ray_bar[axis] += at_bar[axis];
            ray_bar[3 + axis] += at_bar[axis] * node.s;
            s_bar += at_bar[axis] * ray[3 + axis];
        }
        const F plane = this->arguments.planes[node.n];
        if (IS_SLICED) {
            ray_bar[0] -= s_bar / ray[3];
            ray_bar[3] -= s_bar * node.s / ray[3];
        } else {
            ray_bar[6] += s_bar * (F(1) - plane);
            ray_bar[7] += s_bar * plane;
        }
    }

    // To row k of an array that has a number of each ray.
    void put(F* array, int k, V bar) const {
        for (int l = 0; l < LANES && begin + l <= last; ++l)
            array[row_of(k) + begin + l] = P::lane(bar, l);
    }
    void store() {
        for (int b = 0; b < L::BEAMS && VARIES_TABLES && L::HOLDS; ++b)
            for (int h = 0; h < L::TABLES && L::has_curve(b) && !L::is_point(b); ++h)
                spread_table(Cubic<F, V>(foot[b]), h, curve_bar + b * L::HELD + h * L::CURVE);
#if IS_GPU
        for (int c = 0; c <= L::CHANNELS && bars.most; ++c)
            bars.most[c * bars.packets + this->item] = sizes[c];
        if (bars.most) return;
#endif
        for (int k = 0; k <= 2 * L::C; ++k)
            bars.numbers[k * bars.packets + this->item] = P::sum(number_bar[k]);
        if (MOVES && bars.rays) {
            if (this->is_turned) {
                swap(ray_bar[1], ray_bar[2]);
                swap(ray_bar[4], ray_bar[5]);
            }
            for (int l = 0; l < LANES && begin + l <= last; ++l)
                for (int k = 0; k < 8; ++k)
                    bars.rays[8LL * (begin + l) + k] = P::lane(ray_bar[k], l);
        }
        for (int b = 0; b < L::BEAMS && bars.angles; ++b) {
            put(bars.angles, b, foot_bar[b]);
            put(bars.angles, L::BEAMS + b, across_bar[b]);
        }
        for (int k = 0; k < L::EXTINCTION && bars.fronts; ++k) put(bars.fronts, k, m_bar[k]);
    }
};

} // namespace ddrecon
