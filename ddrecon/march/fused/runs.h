#pragma once
#include "ddrecon/kernels/dual.h"
#include "ddrecon/kernels/packets.h"
// Packets of places that are close to each other: their values, in vectors of cells. Some lanes, a
// run, lie between the same two rows and within LANES columns. Columns of a row are read in one
// piece, and lanes pick theirs by a permutation: 1.4 times as fast as lane by lane.

namespace ddrecon {

// Lines of cells across the packet, along which its rays are close to each other (y), and along it
// (x): sizes, and strides in memory.
struct Lines {
    int rows, columns, row, column;
};

// The cells m, i, j, p around a place on a line, which lies a part a of the way from i to j; and
// a (1 - a) / 2, in `excess` of which values are off.
template <class F, class N> struct Place {
    typedef Packets<F> P;
    typedef typename P::V V;
    typedef typename P::I I;
    I m, i, j, p;
    N a, excess;
    static INLINE Place at(V y, int size) {
        const V none = P::all(F(0)), end = P::all(F(size - 1));
        // Also where y is not a number.
        const V held = P::least(P::pick(y > none, y, none), end);
        const I zero = P::whole(none), top = zero + (size - 1);
        const I last = zero + (size > 1 ? size - 2 : 0), cell = P::whole(held);
        Place q;
        q.i = P::pick(cell > last, last, cell);
        q.j = P::pick(q.i + 1 > top, top, q.i + 1);
        q.m = P::pick(q.i > zero, q.i - 1, zero);
        q.p = P::pick(q.j + 1 > top, top, q.j + 1);
        q.a = held - P::real(q.i);
        q.excess = P::pick((y > none) & (y < end), F(0.5) * q.a * (F(1) - q.a), none);
        return q;
    }
    // The same place of lines that begin `by` cells on.
    INLINE Place behind(I by) const { return {m + by, i + by, j + by, p + by, a, excess}; }
};

// Of more runs each lane finds its values itself.
constexpr int MOST_RUNS = 5;

#if defined(__CUDA_ARCH__)
template <class F> struct Runs {
    INLINE Runs() {}
    template <class N> INLINE Runs(const Place<F, N>&, const Place<F, N>&, const Lines&) {}
};
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
    Runs() {}
    Runs(
        const Place<F, typename Packets<F>::V>& y, const Place<F, typename Packets<F>::V>& x,
        const Lines& lines) {
        typedef Packets<F> P;
        typedef typename P::I I;
        const int most = lines.columns > LANES ? lines.columns - LANES : 0;
        const int low = __builtin_reduce_min(x.m), high = __builtin_reduce_max(x.p);
        count = 0;
        if (high - low < LANES && __builtin_reduce_and(y.i == y.i[0])) {
            run[count++] = {ALL_LANES, 0, low, high, low < most ? low : most};
            return;
        }
        for (unsigned rest = ALL_LANES; rest; rest &= ~run[count++].lanes) {
            const int lane = __builtin_ctz(rest);
            const I in_row = (y.i == P::lane_of(y.i, lane)) & P::lanes_of(rest);
            const int low = __builtin_reduce_min(P::pick(in_row, x.m, I{} + lines.columns));
            const I in_run = in_row & (x.p < low + LANES);
            const int high = __builtin_reduce_max(P::pick(in_run, x.p, I{}));
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
    // The same, and 0 at places from LANES on.
    static INLINE V pick_any(V row, I at) { return __builtin_ia32_vpermi2varps512(row, at, V{}); }
    static INLINE I pick_any(I from, I at, I other) {
        return __builtin_ia32_vpermi2vard512(from, at, other);
    }
    // Those `lanes` of x that are named by bits, in front of `others`.
    static INLINE I gather_lanes(I x, unsigned lanes, I others) {
        return __builtin_ia32_compresssi512_mask(x, others, (unsigned short)lanes);
    }
};
#else
template <class F> constexpr bool HAS_PERMUTATION = false;
#endif

// What a run sees of fields: its rows, and lanes' columns within its own.
template <class F> struct Window {
    typedef Packets<F> P;
    typedef Permute<F> Lanes;
    typedef typename P::V V;
    typedef typename P::I I;
    typename P::M is_in;
    I m, i, j, p;
    V a, b;
    long long at_m, at_i, at_j, at_p;
    int first, stride;
    Window(const Run& run, const Place<F, V>& y, const Place<F, V>& x, const Lines& lines)
        : is_in(__builtin_convertvector(P::lanes_of(run.lanes), typename P::M)),
          m(x.m - run.first),
          i(x.i - run.first),
          j(x.j - run.first),
          p(x.p - run.first),
          a(y.a),
          b(x.a),
          at_m((long long)P::lane_of(y.m, run.lane) * lines.row),
          at_i((long long)P::lane_of(y.i, run.lane) * lines.row),
          at_j((long long)P::lane_of(y.j, run.lane) * lines.row),
          at_p((long long)P::lane_of(y.p, run.lane) * lines.row),
          first(run.first),
          stride(lines.column) {}
    INLINE V row(const F* f, long long at) const {
        if (stride == 1) return P::read(f + at + first);
        V x;
        for (int l = 0; l < LANES; ++l) x[l] = f[at + (long long)(first + l) * stride];
        return x;
    }
    INLINE V along(V row) const {
        const V one = Lanes::pick(row, i);
        return one + b * (Lanes::pick(row, j) - one);
    }
    INLINE V linear(const F* f) const {
        const V top = along(row(f, at_i));
        return top + a * (along(row(f, at_j)) - top);
    }
    // As `Corners::curved`.
    INLINE V curved(const F* f, const Place<F, V>& y, const Place<F, V>& x, V& bend) const {
        const V row_i = row(f, at_i), row_j = row(f, at_j);
        const V i0 = Lanes::pick(row_i, i), i1 = Lanes::pick(row_i, j);
        const V j0 = Lanes::pick(row_j, i), j1 = Lanes::pick(row_j, j);
        const V top = i0 + b * (i1 - i0), low = j0 + b * (j1 - j0);
        const V over = along(row(f, at_m)), under = along(row(f, at_p));
        // Second differences along y, and along x in both rows.
        const V along_y = (F(1) - a) * (over - F(2) * top + low) + a * (top - F(2) * low + under);
        const V in_i = (F(1) - b) * (Lanes::pick(row_i, m) - F(2) * i0 + i1) +
                       b * (i0 - F(2) * i1 + Lanes::pick(row_i, p));
        const V in_j = (F(1) - b) * (Lanes::pick(row_j, m) - F(2) * j0 + j1) +
                       b * (j0 - F(2) * j1 + Lanes::pick(row_j, p));
        bend = y.excess * along_y + x.excess * (in_i + a * (in_j - in_i));
        return top + a * (low - top);
    }
};

#endif
} // namespace ddrecon
