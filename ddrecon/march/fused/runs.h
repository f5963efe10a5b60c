#pragma once
#include "ddrecon/march/fused/cells.h"
#include "ddrecon/march/fused/optics.h"
// Neighboring rays meet the same cells: some lanes of a packet, a run, lie between the same two
// rows and within LANES columns. Values: rows of these columns are read in one piece, and lanes
// pick theirs by a permutation, which makes views 1.18 times as fast. Cotangents: cells of the
// columns add up all shares of the run in vectors, and are written once:
//
//                  lane l, with weights L of its columns i, j
//         row m    .  .  .  .  .  .  .
//         row i    .  .  #  #  .  .  .      # += (1 - a) bar L
//         row j    .  .  #  #  .  .  .      # += a bar L
//         row p    .  .  .  .  .  .  .
//               first column

namespace ddrecon {

// Of more runs each lane finds its values itself.
constexpr int MOST_RUNS = 5;

#if IS_GPU
template <class F> struct Runs {
    template <class N> INLINE void find(const Place<F, N>&, const Place<F, N>&, const Lines&) {}
};
template <class F> INLINE void spread_place(
    F* field, const Place<F, F>& y, const Place<F, F>& x, const Lines& lines, F bar, F bend_bar) {
    const F ya = y.a, xa = x.a;
    // Linear weights, and those of a (1 - a) / 2 second differences.
    const F y_linear[4] = {0, 1 - ya, ya, 0}, x_linear[4] = {0, 1 - xa, xa, 0};
    const F y_bend[4] = {1 - ya, 3 * ya - 2, 1 - 3 * ya, ya};
    const F x_bend[4] = {1 - xa, 3 * xa - 2, 1 - 3 * xa, xa};
    for (int j = 0; j < 4; ++j)
        for (int i = 0; i < 4; ++i) {
            const F weight =
                bar * y_linear[j] * x_linear[i] + bend_bar * (y.excess * y_bend[j] * x_linear[i] +
                                                              x.excess * y_linear[j] * x_bend[i]);
            if (weight != F(0))
                Packets<F>::add(field, y.cells[j] * lines.row + x.cells[i] * lines.column, weight);
        }
}
template <class F, class L> INLINE void spread_in_slice(
    F* const* fields, long long offset, const Runs<F>&, const Place<F, F>& y, const Place<F, F>& x,
    const Lines& lines, const F* v_bar, const F* bend_bar) {
    for (int c = 0; c < L::CHANNELS; ++c)
        if (fields[c])
            spread_place(
                fields[c] + offset, y, x, lines, v_bar[c],
                L::is_cubic(c) ? bend_bar[c - L::FIRST_MASS] : F(0));
}
#else
// `lanes` (bits) that are a run, the first of which is `lane`; they need columns `low` to `high`,
// all within LANES columns from `first` on.
struct Run {
    unsigned lanes;
    int lane, low, high, first;
};

// The runs of a packet.
template <class F> struct Runs {
    int count;
    Run run[LANES];
    INLINE void find(
        const Place<F, typename Packets<F>::V>& y, const Place<F, typename Packets<F>::V>& x,
        const Lines& lines) {
        typedef Packets<F> P;
        typedef typename P::I I;
        const int most = lines.columns > LANES ? lines.columns - LANES : 0;
        const int low = __builtin_reduce_min(x.cells[0]), high = __builtin_reduce_max(x.cells[3]);
        count = 0;
        if (high - low < LANES && __builtin_reduce_and(y.cells[1] == y.cells[1][0])) {
            run[count++] = {ALL_LANES, 0, low, high, low < most ? low : most};
            return;
        }
        for (unsigned rest = ALL_LANES; rest; rest &= ~run[count++].lanes) {
            const int lane = __builtin_ctz(rest);
            const I in_row = (y.cells[1] == P::lane_of(y.cells[1], lane)) & P::lanes_of(rest);
            const int low = __builtin_reduce_min(P::pick(in_row, x.cells[0], I{} + lines.columns));
            const I in_run = in_row & (x.cells[3] < low + LANES);
            const int high = __builtin_reduce_max(P::pick(in_run, x.cells[3], I{}));
            const unsigned lanes = P::bits_of(in_run);
            run[count] = {lanes, __builtin_ctz(lanes), low, high, low < most ? low : most};
        }
    }
};

// Permutations of lanes, where processors have them.
template <class F> struct Permute;
#if defined(__AVX512F__)
template <class F> constexpr bool HAS_PERMUTATION = sizeof(F) == 4 && LANES == 16;
template <> struct Permute<float> {
    typedef Packets<float>::V V;
    typedef Packets<float>::I I;
    static INLINE V pick(V row, I at) { return __builtin_ia32_permvarsf512(row, at); }
};
#else
template <class F> constexpr bool HAS_PERMUTATION = false;
#endif

// What a run sees of fields: its rows, and lanes' columns within its own.
template <class F> struct Window {
    typedef Packets<F> P;
    typedef typename P::V V;
    typename P::M is_in;
    Place<F, V> y, x;
    long long rows[4];
    int first, stride;
    Window(const Run& run, const Place<F, V>& y, const Place<F, V>& x, const Lines& lines)
        : is_in(__builtin_convertvector(P::lanes_of(run.lanes), typename P::M)),
          y(y),
          x(x.behind(typename P::I{} - run.first)),
          first(run.first),
          stride(lines.column) {
        for (int r = 0; r < 4; ++r)
            rows[r] = (long long)P::lane_of(y.cells[r], run.lane) * lines.row;
    }
    // As `Spot::value`.
    INLINE V value(const F* f, bool is_cubic, V& bend) const {
        V row[4];
        UNROLLED
        for (int r = 0; r < 4; ++r) {
            if (!is_cubic && (r == 0 || r == 3)) continue;
            if (stride == 1)
                row[r] = P::read(f + rows[r] + first);
            else
                for (int l = 0; l < LANES; ++l)
                    row[r][l] = f[rows[r] + (long long)(first + l) * stride];
        }
        auto cell = [&](int r, int c) HERE { return Permute<F>::pick(row[r], x.cells[c]); };
        return is_cubic ? curved(y, x, cell, bend) : linear(y, x, cell);
    }
};

// What the lanes of a run count for LANES columns of cells, from its first on.
template <class F> struct Shares {
    typedef Numbers<F> P;
    typedef typename P::V V;
    Run run;
    Lines lines;
    long long rows[4];
    V ya, y_excess;
    // Each lane's weights of columns, and those of a (1 - a) / 2 second differences.
    V linear[LANES], cubic[LANES];

    Shares(
        const Run& run, const Place<F, V>& y, const Place<F, V>& x, const Lines& lines,
        bool is_cubic)
        : run(run), lines(lines), ya(y.a), y_excess(y.excess) {
        for (int r = 0; r < 4; ++r)
            rows[r] = (long long)P::lane_of(y.cells[r], run.lane) * lines.row;
        const typename P::I column = P::numbers() + run.first;
        for (unsigned rest = run.lanes; rest; rest &= rest - 1) {
            const int l = __builtin_ctz(rest);
            const F w1 = P::own(x.a, l), w0 = F(1) - w1, excess = P::own(x.excess, l);
            auto at = [&](int c, F weight) HERE -> V {
                const auto is = column == ((const int*)&x.cells[c])[l];
                return P::pick(__builtin_convertvector(is, typename P::M), P::all(weight), V{});
            };
            linear[l] = at(1, w0) + at(2, w1);
            if (is_cubic)
                cubic[l] = (at(0, excess * w0) + at(1, excess * (w1 - F(2) * w0))) +
                           (at(2, excess * (w0 - F(2) * w1)) + at(3, excess * w1));
        }
    }
    // To the rows of a field what values there have as bars, and corrections if it IS_CUBIC.
    template <bool IS_CUBIC> void add(F* field, V bar, V bend_bar = V{}) const {
        const V in_j = bar * ya, bend_j = bend_bar * ya, bend_i = bend_bar - bend_j;
        const V in_m = y_excess * bend_i, in_p = y_excess * bend_j;
        const V bar_i = (bar - in_j) + (in_p - F(2) * in_m), bar_j = in_j + (in_m - F(2) * in_p);
        V sum[4] = {};
        for (unsigned rest = run.lanes; rest; rest &= rest - 1) {
            const int l = __builtin_ctz(rest);
            const V weight = linear[l];
            sum[1] += P::own(bar_i, l) * weight;
            sum[2] += P::own(bar_j, l) * weight;
            if (!IS_CUBIC) continue;
            sum[0] += P::own(in_m, l) * weight;
            sum[3] += P::own(in_p, l) * weight;
            sum[1] += P::own(bend_i, l) * cubic[l];
            sum[2] += P::own(bend_j, l) * cubic[l];
        }
        for (int r = !IS_CUBIC; r < 3 + IS_CUBIC; ++r) write(field + rows[r], sum[r]);
    }
    INLINE void write(F* row, V sum) const {
        if (lines.column == 1 && lines.columns >= LANES) {
            P::write(row + run.first, P::read(row + run.first) + sum);
        } else {
            for (int j = run.low; j <= run.high; ++j)
                row[(long long)j * lines.column] += P::own(sum, j - run.first);
        }
    }
};

// Bars `v_bar` [CHANNELS] of values at places in a slice of `fields`, and `bend_bar` [MASSES] of
// what masses there are off by, added to those fields that are not null.
template <class F, class L, class V> void spread_in_slice(
    F* const* fields, long long offset, const Runs<F>& runs, const Place<F, V>& y,
    const Place<F, V>& x, const Lines& lines, const V* v_bar, const V* bend_bar) {
    typedef Packets<F> P;
    bool is_asked[L::CHANNELS], has_cubic = false;
    typename P::M is_zero = V{} == V{};
    for (int c = 0; c < L::CHANNELS; ++c) {
        const typename P::M is = v_bar[c] == V{};
        is_asked[c] = fields[c] && !P::every(is);
        if (is_asked[c]) is_zero = is_zero & is;
        has_cubic = has_cubic || (is_asked[c] && L::is_cubic(c));
    }
    // Lanes outside of the box count for nothing.
    const unsigned counting = ~P::bits_of(__builtin_convertvector(is_zero, typename P::I));
    for (int r = 0; r < runs.count; ++r) {
        Run run = runs.run[r];
        run.lanes &= counting;
        if (!run.lanes) continue;
        run.lane = __builtin_ctz(run.lanes);
        const Shares<F> shares(run, y, x, lines, has_cubic);
#pragma clang loop unroll(disable)
        for (int c = 0; c < L::CHANNELS; ++c) {
            if (!is_asked[c]) continue;
            F* const field = fields[c] + offset;
            if (L::is_cubic(c))
                shares.template add<true>(field, v_bar[c], bend_bar[c - L::FIRST_MASS]);
            else
                shares.template add<false>(field, v_bar[c]);
        }
    }
}
#endif

} // namespace ddrecon
