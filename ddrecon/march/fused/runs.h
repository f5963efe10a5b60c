#pragma once
#include "ddrecon/march/fused/cells.h"
// Packets of places that are close to each other: their values, in vectors of cells. Some lanes, a
// run, lie between the same two rows and within LANES columns. Columns of a row are read in one
// piece, and lanes pick theirs by a permutation: 1.4 times as fast as lane by lane.

namespace ddrecon {

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
    INLINE V value(const F* f, bool is_bent, V& bend) const {
        V row[4];
        UNROLLED
        for (int r = 0; r < 4; ++r) {
            if (!is_bent && (r == 0 || r == 3)) continue;
            if (stride == 1)
                row[r] = P::read(f + rows[r] + first);
            else
                for (int l = 0; l < LANES; ++l)
                    row[r][l] = f[rows[r] + (long long)(first + l) * stride];
        }
        auto cell = [&](int r, int c) HERE { return Permute<F>::pick(row[r], x.cells[c]); };
        return is_bent ? curved(y, x, cell, bend) : linear(y, x, cell);
    }
};

#endif
} // namespace ddrecon
