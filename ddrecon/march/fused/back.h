#pragma once
#include "ddrecon/march/fused/rays.h"
// The adjoint of the walk along packets of rays. Of the walk out nothing is kept but the mass
// behind each ray: on the walk back values are sampled anew, and masses are those behind less those
// of the segments in between.

namespace ddrecon {

// Cotangents of what the walk found, with the masses that it found, and of what it was given: those
// that are null are not asked for. `bars` are the fields'. Each packet has its own `numbers`
// [2 C + 1, packets].
template <class F> struct Bars {
    const F *out, *masses;
    const double* mass;
    double* numbers;
    F *rays, *angles, *table, *fronts;
    F* const* fields;
    int packets;
};

template <class F, class L, class Which> struct Back : Rays<F, L, Which, ADJOINT> {
    typedef ddrecon::Rays<F, L, Which, ADJOINT> Rays;
    typedef typename Rays::P P;
    typedef typename Rays::V V;
    typedef typename Rays::W W;
    typedef typename Rays::E E;
    typedef typename Rays::Node Node;
    typedef typename Rays::Table Table;
    using Rays::begin, Rays::last, Rays::given, Rays::foot, Rays::across, Rays::row_of;
    using Rays::COSINE, Rays::DEPTH, Rays::NUMBER, Rays::PLACE, Rays::lines;
    using Which::IS_SLICED, Which::VARIES_ANGLES, Which::VARIES_RAYS, Which::VARIES_TABLES;

    const Bars<F>& bars;
    const V none = P::all(F(0));
    V m_bar[L::EXTINCTION], number_bar[2 * L::C + 1],
        curve_bar[VARIES_TABLES * L::HOLDS * L::BEAMS * L::HELD + 1];
    V foot_bar[L::BEAMS + 1], across_bar[L::BEAMS + 1];
    V ray_bar[8] = {none, none, none, none, none, none, none, none};

    Back(int item, const Given<F>& given, const Bars<F>& bars)
        : Rays(item, given, {}), bars(bars) {}
    void run() {
        V bar[L::OUT], inside = none;
        W m[L::EXTINCTION];
        for (int l = 0; l < LANES && begin + l <= last; ++l) P::put(inside, l, F(1));
        bool is_asked = false;
        for (int i = 0; i < L::OUT; ++i) {
            bar[i] = inside * P::load(bars.out + row_of(i), begin, 1, last);
            is_asked = is_asked || !this->is_nothing(bar[i]);
        }
        for (int k = 0; k < L::EXTINCTION; ++k) {
            m_bar[k] = inside * P::load(bars.masses + row_of(k), begin, 1, last);
            m[k] = P::load_wide(bars.mass + row_of(k), begin, last);
            is_asked = is_asked || !this->is_nothing(m_bar[k]);
        }
        for (V& each : number_bar) each = none;
        for (V& each : curve_bar) each = none;
        for (int b = 0; b < L::BEAMS; ++b) foot_bar[b] = across_bar[b] = none;
        // Pixels that nothing is asked of, masked ones for instance, need no walk.
        if (is_asked) walk(bar, m);
        store();
    }

    void walk(const V* bar, W* m) {
        Node nodes[2], *a = nodes, *b = nodes + 1;
        V a_bar[L::CHANNELS], b_bar[L::CHANNELS], wa_bar[L::OUT], wb_bar[L::OUT], ua_bar[L::OUT],
            ub_bar[L::OUT];
        for (int from = this->last_node, to; this->stretch_before(from, to);) {
            for (int c = 0; c < L::CHANNELS; ++c) b_bar[c] = none;
            for (int i = 0; i < L::OUT; ++i) wb_bar[i] = ub_bar[i] = none;
            V ta_bar, tb_bar = none;
            this->locate(to, *b);
            this->emit(to, *b, m);
            // Node b lies behind node a. Its bars grow by the segments on both sides, then it is
            // done.
            for (int n = to - 1; n >= from; --n) {
                W m_b[L::EXTINCTION];
                this->locate(n, *a);
                for (int k = 0; k < L::EXTINCTION; ++k) {
                    m_b[k] = m[k];
                    m[k] -= this->mass_between(*a, *b, k);
                }
                this->emit(n, *a, m);
                V length_bar = none, begin_bar = none, end_bar = none;
                for (int i = 0; i < L::OUT; ++i) {
                    const Decay<F> decay(a->u[i], b->u[i], a->decay[i], b->decay[i]);
                    const V half = F(0.5) * bar[i] * this->measure(*a, *b, i);
                    const V both = half * (a->w[i] + b->w[i]);
                    wa_bar[i] = half * decay.mean;
                    wb_bar[i] += wa_bar[i];
                    ua_bar[i] = both * decay.by0;
                    ub_bar[i] += both * decay.by1;
                    const int beam = i / L::C - 1;
                    const V by = F(0.5) * bar[i] * (a->w[i] + b->w[i]) * decay.mean;
                    if (VARIES_ANGLES && i >= L::C && L::is_point(beam)) {
                        Dual<V, 4> x[] = {foot[beam], across[beam], a->t, b->t};
                        for (int k = 0; k < 4; ++k) x[k].by[k] = P::all(F(1));
                        const auto slopes = Point<F>::subtended(x[0], x[1], x[2], x[3]);
                        foot_bar[beam] += by * slopes.by[0];
                        across_bar[beam] += by * slopes.by[1];
                        begin_bar += by * slopes.by[2];
                        end_bar += by * slopes.by[3];
                    } else if (VARIES_RAYS) {
                        length_bar += by;
                    }
                }
                if (VARIES_ANGLES) tb_bar += end_bar;
                finish(*b, m_b, b_bar, wb_bar, ub_bar, tb_bar);
                // Its mass is that of node a and half the sum of extinctions, by the length.
                for (int c = 0; c < L::CHANNELS; ++c) a_bar[c] = none;
                for (int k = 0; k < L::EXTINCTION; ++k) {
                    a_bar[k] = F(0.5) * m_bar[k] * (b->t - a->t);
                    b_bar[k] += a_bar[k];
                    if (VARIES_RAYS) length_bar += F(0.5) * m_bar[k] * (a->v[k] + b->v[k]);
                }
                ta_bar = -length_bar;
                if (VARIES_ANGLES) ta_bar += begin_bar;
                spread(n + 1, *b, b_bar, tb_bar + length_bar);
                tb_bar = ta_bar;
                for (int c = 0; c < L::CHANNELS; ++c) b_bar[c] = a_bar[c];
                for (int i = 0; i < L::OUT; ++i) {
                    wb_bar[i] = wa_bar[i];
                    ub_bar[i] = ua_bar[i];
                }
                Node* const passed = b;
                b = a;
                a = passed;
            }
            finish(*b, m, b_bar, wb_bar, ub_bar, tb_bar);
            spread(from, *b, b_bar, tb_bar);
        }
    }

    // What node b emits, and its values go back to the cells. Its mass is that behind it, `m`.
    void finish(const Node& node, const W* m, V* v_bar, const V* w_bar, const V* u_bar, V& t_bar) {
        for (int c = 0; c < L::C; ++c) {
            const int k = L::extinction(c), s = L::diffusing(c);
            const int d = L::diffuse(c);
            const V scattering = node.v[s];
            v_bar[s] += w_bar[c] * node.v[d];
            v_bar[d] += w_bar[c] * scattering;
            if constexpr (L::EMITTED > 0) v_bar[L::emitted(c)] += w_bar[c];
            m_bar[k] += u_bar[c] * this->number(c);
            number_bar[c] += u_bar[c] * P::narrow(m[k]);
        }
        for (int b = 0; b < L::BEAMS; ++b) {
            V place_bar = none, cosine_bar = none;
            for (int c = 0; c < L::C; ++c) {
                const int k = L::extinction(c), s = L::scattering(c);
                const int i = L::C + b * L::C + c, j = L::mass(b, c);
                const V way = P::narrow(m[k]) + node.v[j];
                const V p_bar = w_bar[i] * node.v[s];
                V way_bar = u_bar[i] * this->number(c);
                number_bar[c] += u_bar[i] * way;
                v_bar[s] += w_bar[i] * node.p[i].value;
                // What scatters nothing has no phase function to vary.
                if (!node.is_empty) {
                    finish_phase(node.p[i], node, c, way, p_bar, v_bar, way_bar);
                    if constexpr (VARIES_ANGLES) place_bar += p_bar * node.p[i].by[PLACE];
                    if constexpr (VARIES_ANGLES && L::IS_SCALED)
                        cosine_bar += p_bar * node.p[i].by[COSINE];
                    if constexpr (VARIES_TABLES)
                        if (L::has_curve(b)) finish_curve(node, b, c, way, p_bar);
                }
                m_bar[k] += way_bar;
                v_bar[j] += way_bar;
            }
            if (VARIES_ANGLES) turn(node, b, place_bar, cosine_bar, t_bar);
        }
    }
    // What p in color c had of mass on the `way`, and of the number there.
    void finish_phase(const E& p, const Node& node, int c, V way, V p_bar, V* v_bar, V& way_bar) {
        if constexpr (L::HAS_PEAK) {
            const V depth_bar = p_bar * p.by[DEPTH];
            way_bar += depth_bar * this->peak_of(node, c);
            if (L::IS_PEAK_FIELD)
                v_bar[L::peak(c)] += depth_bar * way;
            else
                number_bar[L::C + c] += depth_bar * way;
        }
        if constexpr (L::HAS_NUMBERS) v_bar[L::FIRST_NUMBER + L::number(c)] += p_bar * p.by[NUMBER];
    }
    // What p of beam b in color c had of the coefficients in its table.
    void finish_curve(const Node& node, int b, int c, V way, V p_bar) {
        const int table = L::table(c);
        const bool is_held = L::HOLDS && !L::is_point(b);
        V number = none, cosine, bars_at_node[L::CURVE] = {};
        if (L::HAS_NUMBERS)
            number = number_place<F, L::IS_SCALED>(node.v[L::FIRST_NUMBER + L::number(c)]);
        if (L::HAS_PEAK) p_bar = P::pick(node.p[L::C + b * L::C + c].value > none, p_bar, none);
        V* const bar = is_held ? curve_bar + b * L::HELD + table * L::CURVE : bars_at_node;
        const V depth = L::HAS_PEAK ? value_of(this->peak_of(node, c)) * way : none;
        Polynomials<F, L::TERMS, L::POWERS>::spread(p_bar, depth, number, bar);
        if (is_held) return;
        const auto place = this->see(b, foot[b], across[b], node.t, cosine);
        Table::spread(place, bars.table + table * Table::SIZE, bar);
    }
    // What bars of beam b's place in tables, and of the cosine there, are for its angles.
    void turn(const Node& node, int b, V place_bar, V cosine_bar, V& t_bar) {
        Dual<V, 3> x[] = {foot[b], across[b], node.t}, cosine;
        for (int k = 0; k < 3; ++k) x[k].by[k] = P::all(F(1));
        const Dual<V, 3> place = this->see(b, x[0], x[1], x[2], cosine).part;
        V* const of[] = {&foot_bar[b], &across_bar[b], &t_bar};
        for (int k = 0; k < 3; ++k) *of[k] += place_bar * place.by[k] + cosine_bar * cosine.by[k];
    }

    void spread(int n, const Node& node, const V* v_bar, V t_bar) {
        V bend_bar[L::MASSES + 1];
        for (int k = 0; k < L::MASSES; ++k) {
            const V off = this->number(2 * L::C) * node.bend[k], inverse = node.limit[k];
            bend_bar[k] = -v_bar[L::FIRST_MASS + k] * inverse * inverse * inverse;
            number_bar[2 * L::C] -= bend_bar[k] * off * node.bend[k] * node.bend[k];
        }
        if constexpr (IS_SLICED)
            spread_in_slice<F, L>(
                bars.fields, this->slice(n), node.runs, node.y, node.x, lines, v_bar, bend_bar);
        else
            spread_between(node, v_bar, bend_bar);
        if constexpr (VARIES_RAYS) move(n, node, v_bar, bend_bar, t_bar);
    }
    void spread_between(const Node& node, const V* v_bar, const V* bend_bar) const {
        const Layers<F, V> layers(node.z);
        for (int i = 0; i < 4; ++i) {
            if (layers.is_outer(i) && !L::MASSES) continue;
            V value_bar[L::CHANNELS], linear_bar[L::MASSES + 1];
            for (int c = 0; c < L::CHANNELS; ++c) value_bar[c] = layers.linear[i] * v_bar[c];
            for (int k = 0; k < L::MASSES; ++k) {
                value_bar[L::FIRST_MASS + k] += layers.across[i] * bend_bar[k];
                linear_bar[k] = layers.linear[i] * bend_bar[k];
            }
            const auto row = node.y.behind(node.z.cells[i] * lines.rows);
            Runs<F> runs;
            runs.find(row, node.x, lines);
            spread_in_slice<F, L>(bars.fields, 0, runs, row, node.x, lines, value_bar, linear_bar);
        }
    }

    // What the bars of node n are for its ray: of its values and their bends, and of its distance.
    void move(int n, const Node& node, const V* v_bar, const V* bend_bar, V t_bar) {
        V at_bar[3] = {none, none, none};
        this->take_slopes(n, node.s, 0, L::CHANNELS, [&](int c, const auto& v, const auto& bend) {
            for (int k = 0; k < (IS_SLICED ? 2 : 3); ++k) {
                at_bar[k] += v_bar[c] * v.by[k];
                if (L::is_cubic(c)) at_bar[k] += bend_bar[c - L::FIRST_MASS] * bend.by[k];
            }
        });
        Dual<V, 8> ray[8];
        for (int k = 0; k < 8; ++k) {
            ray[k] = this->ray[k];
            ray[k].by[k] = P::all(F(1));
        }
        const int axes[] = {1, 2, 0};
        const auto s = this->distance(ray, n), t = this->clamp(ray, s);
        for (int k = 0; k < 8; ++k) ray_bar[k] += t_bar * t.by[k];
        for (int i = 0; i < (IS_SLICED ? 2 : 3); ++i) {
            const auto place = this->place(ray, s, axes[i]);
            for (int k = 0; k < 8; ++k) ray_bar[k] += at_bar[i] * place.by[k];
        }
    }

    // To row k of an array that has a number of each ray.
    void put(F* array, int k, V bar) const {
        for (int l = 0; l < LANES && begin + l <= last; ++l)
            array[row_of(k) + begin + l] = P::lane(bar, l);
    }
    void store() const {
        for (int k = 0; k <= 2 * L::C; ++k)
            bars.numbers[k * bars.packets + this->item] = P::sum(number_bar[k]);
        if (VARIES_RAYS && bars.rays) {
            const int y = this->is_turned ? 2 : 1, x = 3 - y,
                      order[] = {0, y, x, 3, 3 + y, 3 + x, 6, 7};
            for (int l = 0; l < LANES && begin + l <= last; ++l)
                for (int k = 0; k < 8; ++k)
                    bars.rays[8LL * (begin + l) + k] = P::lane(ray_bar[order[k]], l);
        }
        for (int b = 0; b < L::BEAMS && bars.angles; ++b) {
            put(bars.angles, b, foot_bar[b]);
            put(bars.angles, L::BEAMS + b, across_bar[b]);
        }
        for (int k = 0; k < L::EXTINCTION && bars.fronts; ++k) put(bars.fronts, k, m_bar[k]);
        for (int b = 0; b < L::BEAMS && VARIES_TABLES && L::HOLDS; ++b)
            for (int h = 0; h < L::TABLES && L::has_curve(b) && !L::is_point(b); ++h)
                Table::spread(
                    Table::place(foot[b]), bars.table + h * Table::SIZE,
                    curve_bar + b * L::HELD + h * L::CURVE);
    }
};

} // namespace ddrecon
