#pragma once
#include "ddrecon/march/fused/runs.h"
// A packet of rays: what stands where in a node's values (`kernels.py`), where its nodes lie, what
// they emit, and the integral of that.

namespace ddrecon {

// Channels that colors share, of a kind with one, are those of each. Without a peak it has -1
// channels; as a number for each color, 0.
template <
    int COLORS, int EXTINCTIONS, int DIFFUSES, int SCATTERINGS, int EMITTEDS, int PEAKS,
    int NUMBER_COUNT, int REMAINING, int TABLE_COUNT, int POWER_COUNT, bool SCALES, bool... POINTS>
struct Layout {
    static constexpr int C = COLORS, EXTINCTION = EXTINCTIONS, SCATTERING = SCATTERINGS;
    static constexpr int EMITTED = EMITTEDS, BEAMS = sizeof...(POINTS), TABLES = TABLE_COUNT;
    static constexpr bool HAS_PEAK = PEAKS >= 0, IS_PEAK_FIELD = PEAKS > 0;
    static constexpr int NUMBERS = NUMBER_COUNT;
    static constexpr bool HAS_NUMBERS = NUMBERS > 0, IS_SCALED = SCALES;
    // All outputs: of diffuse light, then of each beam.
    static constexpr int MASSES = BEAMS * EXTINCTION, OUT = (1 + BEAMS) * C;
    static constexpr int FIRST_MASS = EXTINCTION + DIFFUSES, AFTER_MASSES = FIRST_MASS + MASSES;
    static constexpr int FIRST_EMITTED = AFTER_MASSES + SCATTERING;
    static constexpr int FIRST_PEAK = FIRST_EMITTED + EMITTED;
    static constexpr int FIRST_NUMBER = FIRST_PEAK + (IS_PEAK_FIELD ? PEAKS : 0);
    static constexpr int FIRST_REMAINING = FIRST_NUMBER + NUMBERS;
    static constexpr int CHANNELS = FIRST_REMAINING + REMAINING;
    // Coefficients of p over the depth of the peak, and over the number of the cell.
    static constexpr int TERMS = HAS_PEAK ? COEFFICIENTS : 1, POWERS = POWER_COUNT;
    static constexpr int CURVE = TERMS * POWERS;
    // Whether a thread holds those of an angle all together: on a GPU many are read one by one.
    static constexpr bool HOLDS = !IS_GPU || POWERS == 1;
    static constexpr int HELD = TABLES * (HOLDS ? CURVE : TERMS);

    static constexpr INLINE int at(int first, int channels, int c) {
        return first + (channels > 1 ? c : 0);
    }
    // Of color c: its extinction, also among masses; diffuse light, what scatters that, and beams.
    static constexpr INLINE int extinction(int c) { return at(0, EXTINCTION, c); }
    static constexpr INLINE int diffuse(int c) { return at(EXTINCTION, DIFFUSES, c); }
    static constexpr INLINE int diffusing(int c) {
        return REMAINING ? at(FIRST_REMAINING, REMAINING, c) : scattering(c);
    }
    static constexpr INLINE int scattering(int c) {
        return SCATTERING ? at(AFTER_MASSES, SCATTERING, c) : extinction(c);
    }
    static constexpr INLINE int emitted(int c) { return at(FIRST_EMITTED, EMITTED, c); }
    static constexpr INLINE int mass(int b, int c) {
        return FIRST_MASS + b * EXTINCTION + extinction(c);
    }
    static constexpr INLINE int peak(int c) { return at(FIRST_PEAK, PEAKS, c); }
    // Which number of the phase function is its own, and which table.
    static constexpr INLINE int number(int c) { return at(0, NUMBERS, c); }
    static constexpr INLINE int table(int c) { return at(0, TABLES, c); }
    static constexpr INLINE bool is_cubic(int c) { return c >= FIRST_MASS && c < AFTER_MASSES; }
    // Whether beam b is a point light: known to be none where there are none.
    static constexpr INLINE bool is_point(int b) {
        constexpr bool points[] = {POINTS..., false};
        return (POINTS || ... || false) && points[b];
    }
    // Whether p changes along a ray, of any beam; and of beam b.
    static constexpr bool HAS_CURVES = BEAMS && (HAS_PEAK || HAS_NUMBERS || (POINTS || ...));
    static constexpr INLINE bool has_curve(int b) { return HAS_PEAK || HAS_NUMBERS || is_point(b); }
};

// What a kernel is called with. Nodes lie in `slices` [N] of `fields`, channels of cells, at
// `planes` [N] across them [u]; or, where there are none, anywhere: at such parts of the way from
// near to far. `rays` [R, 8]: origin and direction (in cells; across slices in u), near, far [u].
// `angles` [2 beams, R]: of each beam the angle in steps of a table, of a point light the foot;
// then of each the cosine, of a point light the square distance. `numbers`: scale and peak by
// color, bound of third-order corrections. `table` [tables * (steps + 1) * 2, CURVE]: coefficients
// of p by angle. `fronts` [K, R]: the mass before the rays, if any. `walked` [packets, words]: bits
// of the segments to be walked, if not all are. Item i is packet i, or `dealt` [packets] says
// which.
template <class F> struct Arguments {
    const F *planes, *rays, *angles, *numbers, *table, *fronts;
    const int *slices, *walked, *dealt;
    int ray_count, node_count, depth, rows, columns, words;
    int plane_stride, row_stride, column_stride;
    const F* const* fields;
    // Where row k of an array begins that has a number of each ray.
    INLINE long long row_of(int k) const { return (long long)k * ray_count; }
};
// The changes of some of that, those left out being 0; the fields' come behind the fields.
template <class F> struct Changes {
    const F *rays, *angles, *numbers, *table, *fronts;
};

// Whether nodes lie in slices; and whether derivatives are asked for by rays or by the angles at
// which they see beams, and by the tables.
template <bool SLICED, bool MOVED, bool TABLES> struct Case {
    static constexpr bool IS_SLICED = SLICED, MOVES = MOVED, VARIES_TABLES = TABLES;
};

// A walk finds values; or values and changes, where numbers N are dual; or what an adjoint needs:
// values, and p with its derivatives, a dual number E.
enum Mode { VALUES, TANGENT, ADJOINT };

template <class F, class L, class Which, Mode MODE> struct Rays : Which {
    typedef Numbers<F> P;
    typedef typename P::V V;
    typedef typename P::W W;
    using Which::IS_SLICED, Which::MOVES, Which::VARIES_TABLES;
    typedef ddrecon::Table<F, L::CURVE> Table;

    // In an adjoint p has derivatives by the depth of the peak, by the number of the cell, by the
    // place in tables, and where p is scaled by the cosine.
    static constexpr bool IS_TANGENT = MODE == TANGENT, IS_ADJOINT = MODE == ADJOINT;
    static constexpr bool TURNS = MOVES && L::HAS_CURVES;
    static constexpr int DEPTH = 0, NUMBER = L::HAS_PEAK, PLACE = NUMBER + L::HAS_NUMBERS;
    static constexpr int COSINE = PLACE + TURNS, DIRECTIONS = COSINE + (TURNS && L::IS_SCALED);
    // Of values; of p; of distances and angles along rays; of coefficients of p; of masses.
    typedef typename If<IS_TANGENT, Dual<V>, V>::type N;
    typedef typename If<IS_ADJOINT, Dual<V, DIRECTIONS ? DIRECTIONS : 1>, N>::type E;
    typedef typename If<MOVES, N, V>::type Length;
    typedef typename If<MOVES || (IS_TANGENT && VARIES_TABLES), E, V>::type Coefficient;
    typedef typename If<IS_TANGENT, Dual<W>, W>::type Mass;

    // Node n: whether it `is_empty` for all lanes, and `is_lit`, has all its values; distances `s`
    // sampled at and `t` clamped to the box; values; emission, depth, exp(-depth), and p.
    struct Node : Spot<F, IS_SLICED, Length> {
        Runs<F> runs;
        int n;
        bool is_empty, is_lit;
        Length s, t;
        N v[L::CHANNELS], bend[L::MASSES + 1], w[L::OUT], u[L::OUT];
        V limit[L::MASSES + 1], decay[L::OUT];
        E p[L::OUT];
    };

    const Arguments<F>& arguments;
    const Changes<F> changes;
    int item, last, begin, first_node = 0, last_node;
    // Origin, direction, near and far.
    Length ray[8];
    // Both `angles` of each beam, and p's coefficients of those that are no point lights.
    Length foot[L::BEAMS + 1], across[L::BEAMS + 1];
    Coefficient curves[L::BEAMS * L::HELD + 1];
    // Along y the packet's rays are closer together than along x; it `is_turned` where y are
    // columns.
    bool is_turned = false;
    Lines lines;

    Rays(int number, const Arguments<F>& arguments, const Changes<F>& changes)
        : arguments(arguments),
          changes(changes),
          item(arguments.dealt ? arguments.dealt[number] : number),
          last(arguments.ray_count - 1),
          begin(item * LANES),
          last_node(arguments.node_count - 1),
          lines{arguments.rows, arguments.columns, arguments.row_stride, arguments.column_stride} {
        for (int k = 0; k < 8; ++k) ray[k] = load<Length>(arguments.rays, changes.rays, k, 8);
        for (int b = 0; b < L::BEAMS; ++b) {
            foot[b] = load<Length>(arguments.angles, changes.angles, row_of(b));
            across[b] = load<Length>(arguments.angles, changes.angles, row_of(L::BEAMS + b));
            if (L::has_curve(b) && !L::is_point(b))
                read_tables(Cubic<F, Length>(foot[b]), curves + b * L::HELD);
        }
        // Nodes before the box and behind it are clamped to its faces: between them nothing is
        // added.
        const V near = value_of(ray[6]), far = value_of(ray[7]);
        while (first_node < last_node && P::every(value_of(distance(first_node + 1)) <= near))
            ++first_node;
        while (last_node > first_node && P::every(value_of(distance(last_node - 1)) >= far))
            --last_node;
        if (P::every(near >= far)) last_node = first_node;
        if (LANES > 1 && IS_SLICED) turn();
    }
    void turn() {
        const Length s = distance((first_node + last_node) / 2);
        const V y = value_of(place(s, 1)), x = value_of(place(s, 2));
        const int end = begin + LANES <= last ? LANES - 1 : last - begin;
        const F high = P::lane(y, end) - P::lane(y, 0), wide = P::lane(x, end) - P::lane(x, 0);
        if (high * high <= wide * wide) return;
        is_turned = true;
        lines = {lines.columns, lines.rows, lines.column, lines.row};
        swap(ray[1], ray[2]);
        swap(ray[4], ray[5]);
    }
    long long row_of(int k) const { return arguments.row_of(k); }
    // What the rays have at `at` of an array, and its change.
    template <class X> X load(const F* array, const F* change, long long at, int step = 1) const {
        const V value = P::load(array + at, begin, step, last);
        if constexpr (sizeof(X) == sizeof(V))
            return value;
        else
            return {value, change ? P::load(change + at, begin, step, last) : P::all(F(0))};
    }
    // And a number that all rays share: a color's scale, its peak, or the bound.
    N number(int k) const {
        const V value = P::all(arguments.numbers[k]);
        if constexpr (IS_TANGENT)
            return {value, P::all(changes.numbers[k])};
        else
            return value;
    }
    Mass front(int k) const {
        if (!arguments.fronts) return P::wide(N(P::all(F(0))));
        return P::wide(load<N>(arguments.fronts, changes.fronts, row_of(k)));
    }

    // Whether segment n, behind node n - 1, is to be walked; the next stretch of such segments
    // behind node `to`, and the one before node `from`: nodes `from` to `to`; whether there is one.
    bool walks(int n) const {
        const long long word = (long long)item * arguments.words + n / 32;
        return !arguments.walked || (arguments.walked[word] >> (n % 32) & 1);
    }
    bool next_stretch(int& from, int& to) const {
        for (from = to; from < last_node && !walks(from + 1);) ++from;
        for (to = from; to < last_node && walks(to + 1);) ++to;
        return from < to;
    }
    bool stretch_before(int& from, int& to) const {
        for (to = from; to > first_node && !walks(to);) --to;
        for (from = to; from > first_node && walks(from);) --from;
        return from < to;
    }

    // The distance of node n; the same clamped to the box; and where it is then across slices,
    // along y, and along x.
    Length distance(int n) const {
        if (IS_SLICED) return (arguments.planes[n] - ray[0]) / ray[3];
        return ray[6] + arguments.planes[n] * (ray[7] - ray[6]);
    }
    Length clamp(const Length& s) const { return P::least(P::most(s, ray[6]), ray[7]); }
    Length place(const Length& s, int axis) const { return ray[axis] + s * ray[3 + axis]; }
    long long slice(int n) const {
        return IS_SLICED ? (long long)arguments.slices[n] * arguments.plane_stride : 0;
    }
    // Field c, in a slice of node n, and of numbers N its change.
    auto field(int c, int n) const {
        const F* const change = IS_TANGENT ? arguments.fields[L::CHANNELS + c] : nullptr;
        return readable<N>(arguments.fields[c], change) + slice(n);
    }
    // Where node n lies, and the matter there.
    void locate(int n, Node& node) const {
        node.n = n;
        node.s = distance(n);
        node.t = clamp(node.s);
        node.y = Place<F, Length>(place(node.s, 1), lines.rows);
        node.x = Place<F, Length>(place(node.s, 2), lines.columns);
        if (!IS_SLICED) node.z = Place<F, Length>(place(node.s, 0), arguments.depth);
        if (IS_SLICED) node.runs.find(node.y, node.x, lines);
        sample(node, 0, L::EXTINCTION);
        if (L::SCATTERING || L::EMITTED) sample(node, L::AFTER_MASSES, L::FIRST_PEAK);
        node.is_empty = true;
        for (int c = 0; c < L::FIRST_PEAK; ++c)
            if (c < L::EXTINCTION || c >= L::AFTER_MASSES)
                node.is_empty = node.is_empty && is_nothing(node.v[c]);
    }
    static bool is_nothing(const V& x) { return P::every(x == P::all(F(0))); }
    static bool is_nothing(const Dual<V>& x) { return is_nothing(x.value) && is_nothing(x.by[0]); }
    // Values of channels `from` to before `to`.
    void sample(Node& node, int from, int to) const {
#if !IS_GPU
        if constexpr (IS_SLICED && HAS_PERMUTATION<F>)
            if (node.runs.count <= MOST_RUNS && lines.columns >= LANES) {
                for (int r = 0; r < node.runs.count; ++r) {
                    const Window<F, Length> w(node.runs.run[r], node.y, node.x, lines);
                    for (int c = from; c < to; ++c) {
                        N bend(P::all(F(0)));
                        const N v = w.value(field(c, node.n), L::is_cubic(c), bend);
                        node.v[c] = P::pick(w.is_in, v, node.v[c]);
                        if (!L::is_cubic(c)) continue;
                        N& known = node.bend[c - L::FIRST_MASS];
                        known = P::pick(w.is_in, bend, known);
                    }
                }
                return;
            }
#endif
        for (int c = from; c < to; ++c) {
            N bend(P::all(F(0)));
            node.v[c] = node.value(field(c, node.n), lines, L::is_cubic(c), bend);
            if (L::is_cubic(c)) node.bend[c - L::FIRST_MASS] = bend;
        }
    }

    N peak_of(const Node& node, int c) const {
        return L::IS_PEAK_FIELD ? node.v[L::peak(c)] : number(L::C + c);
    }
    // A number by which p has derivatives in an adjoint.
    template <int DIRECTION, class X, class A> static X seed(const A& a) {
        X x(a);
        if constexpr (IS_ADJOINT && IS_DUAL<X> && DIRECTION < DIRECTIONS)
            x.by[DIRECTION] = P::all(F(1));
        return x;
    }
    // The first `count` coefficients of p from `first` on in table h, cubic in the angle.
    void read_table(
        const Cubic<F, Length>& place, int h, int first, int count,
        Coefficient* coefficients) const {
        const Cubic<F, Coefficient> angle(place.first, seed<PLACE, Coefficient>(place.fraction));
        const int at = h * Table::SIZE + first;
        Table::read(angle, arguments.table + at, count, coefficients);
        if constexpr (IS_TANGENT && VARIES_TABLES) {
            V change[L::HELD / L::TABLES];
            if (changes.table) Table::read(place.value(), changes.table + at, count, change);
            for (int k = 0; k < count && changes.table; ++k) coefficients[k].by[0] += change[k];
        }
    }
    // All coefficients of p, from all tables, if they are HELD.
    void read_tables(const Cubic<F, Length>& place, Coefficient* held) const {
        for (int h = 0; h < L::TABLES && L::HOLDS; ++h)
            read_table(place, h, 0, L::CURVE, held + h * L::CURVE);
    }
    // Where the light of beam b is in tables at a distance, and the cosine of its angle there.
    template <class X>
    static Cubic<F, X> see(int b, const X& foot, const X& across, const X& distance, X& cosine) {
        if (L::is_point(b)) return Point<F>::see(foot, across, distance, cosine);
        cosine = across;
        return Cubic<F, X>(foot);
    }
    // All else at a node: all outputs' emission, depth and p behind the mass `m`.
    void emit(Node& node, const Mass* m) const {
        sample(node, L::EXTINCTION, L::AFTER_MASSES);
        if (L::FIRST_PEAK < L::CHANNELS) sample(node, L::FIRST_PEAK, L::CHANNELS);
        for (int k = 0; k < L::MASSES; ++k) {
            const N off = number(2 * L::C) * node.bend[k], limit = F(1) / P::root(F(1) + off * off);
            // On faces that are lit it is 0 but for rounding, whose exponential may overflow.
            const N corrected = node.v[L::FIRST_MASS + k] - node.bend[k] * limit;
            node.v[L::FIRST_MASS + k] = P::most(corrected, F(-4) / number(2 * L::C));
            node.limit[k] = value_of(limit);
        }
        for (int c = 0; c < L::C; ++c) {
            const N scattering = node.v[L::diffusing(c)];
            node.w[c] = scattering * node.v[L::diffuse(c)];
            if constexpr (L::EMITTED > 0) node.w[c] += node.v[L::emitted(c)];
            node.u[c] = number(c) * P::narrow(m[L::extinction(c)]);
        }
        E numbers[L::NUMBERS + 1], places[L::NUMBERS + 1];
        for (int k = 0; k < L::NUMBERS; ++k) {
            numbers[k] = seed<NUMBER, E>(node.v[L::FIRST_NUMBER + k]);
            places[k] = number_place<F, L::IS_SCALED>(numbers[k]);
        }
        for (int b = 0; b < L::BEAMS; ++b) {
            Coefficient at_node[L::HELD];
            const bool is_held = L::HOLDS && !L::is_point(b);
            const Coefficient* const held = is_held ? curves + b * L::HELD : at_node;
            Length cosine;
            const Cubic<F, Length> place = see(b, foot[b], across[b], node.t, cosine);
            if (L::is_point(b)) read_tables(place, at_node);
            for (int c = 0; c < L::C; ++c) {
                const int i = L::C + b * L::C + c, k = L::number(c);
                const N scattering = node.v[L::scattering(c)];
                const N passed = P::narrow(m[L::extinction(c)]) + node.v[L::mass(b, c)];
                E p(P::all(F(1)));
                if (L::has_curve(b)) {
                    auto row = [&](int m) -> const Coefficient* {
                        if (L::HOLDS) return held + L::table(c) * L::CURVE + m * L::TERMS;
                        read_table(place, L::table(c), m * L::TERMS, L::TERMS, at_node);
                        return at_node;
                    };
                    const E depth = seed<DEPTH, E>(peak_of(node, c) * passed);
                    p = Polynomials<F, L::TERMS, L::POWERS>::template at<E>(row, depth, places[k]);
                }
                if (L::HAS_PEAK) p = P::most(p, E(P::all(F(0))));
                if constexpr (L::IS_SCALED)
                    p = p * henyey_greenstein<F>(numbers[k], seed<COSINE, E>(cosine));
                node.p[i] = p;
                if constexpr (IS_ADJOINT)
                    node.w[i] = scattering * p.value;
                else
                    node.w[i] = scattering * p;
                node.u[i] = number(c) * passed;
            }
        }
        for (int i = 0; i < L::OUT; ++i) node.decay[i] = P::decay(value_of(node.u[i]));
    }
    Mass mass_between(const Node& a, const Node& b, int k) const {
        return P::wide(F(0.5) * (a.v[k] + b.v[k]) * (b.t - a.t));
    }
    // What output i is integrated by: length, or for a point light the integral of 1 / r^2.
    Length measure(const Node& a, const Node& b, int i) const {
        const int beam = i / L::C - 1;
        if (i < L::C || !L::is_point(beam)) return b.t - a.t;
        return Point<F>::subtended(foot[beam], across[beam], a.t, b.t);
    }
};

// The integral along a packet of rays, from the camera into the volume (E2.1 to E2.3): `out`
// [outputs, R] and `masses` [K, R]; or in a TANGENT the changes of both.
template <class F, class L, class Which, Mode MODE, class Masses> void walk(
    int item, const Arguments<F>& arguments, const Changes<F>& changes, F* out, Masses* masses) {
    typedef ddrecon::Rays<F, L, Which, MODE> Rays;
    typedef typename Rays::P P;
    typedef typename Rays::N N;
    const Rays rays(item, arguments, changes);
    N total[L::OUT];
    typename Rays::Mass m[L::EXTINCTION];
    for (int i = 0; i < L::OUT; ++i) total[i] = N(P::all(F(0)));
    for (int k = 0; k < L::EXTINCTION; ++k) m[k] = rays.front(k);
    typename Rays::Node nodes[2], *a = nodes, *b = nodes + 1;
    for (int from, to = rays.first_node; rays.next_stretch(from, to);) {
        rays.locate(from, *a);
        a->is_lit = false;
        for (int n = from + 1; n <= to; ++n) {
            rays.locate(n, *b);
            b->is_lit = !(a->is_empty && b->is_empty);
            // Between empty nodes nothing is added: what light there is does not matter.
            if (b->is_lit) {
                if (!a->is_lit) rays.emit(*a, m);
                // The mass passed on the way to the next node, and what it emits behind that.
                for (int k = 0; k < L::EXTINCTION; ++k) m[k] += rays.mass_between(*a, *b, k);
                rays.emit(*b, m);
                // E2.2, E2.3: what arrives from the segment between both.
                for (int i = 0; i < L::OUT; ++i) {
                    const N decay = Decay<F>::of(a->u[i], b->u[i], a->decay[i], b->decay[i]);
                    total[i] += F(0.5) * (a->w[i] + b->w[i]) * rays.measure(*a, *b, i) * decay;
                }
            }
            swap(a, b);
        }
    }
    for (int l = 0; l < LANES && rays.begin + l <= rays.last; ++l) {
        for (int i = 0; i < L::OUT; ++i)
            out[rays.row_of(i) + rays.begin + l] = P::lane(change_of(total[i]), l);
        for (int k = 0; k < L::EXTINCTION; ++k)
            masses[rays.row_of(k) + rays.begin + l] = P::lane_of(change_of(m[k]), l);
    }
}

} // namespace ddrecon
