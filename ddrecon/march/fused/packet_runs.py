"""C++ of packets of places that are close to each other: their values, in vectors of cells.

Some lanes, a run, lie between the same two rows and within LANES columns. Columns of a row are read
in one piece, and lanes pick theirs by a permutation.
"""

RUNS = """
// Of more runs each lane finds its values itself.
constexpr int MOST_RUNS = 5;
#if !defined(__CUDA_ARCH__)
// `lanes` (bits) that are a run, the first of which is `lane`; they need columns `low` to `high`,
// all within LANES columns from `first` on.
struct Run { unsigned lanes; int lane, low, high, first; };
// The runs of a packet; how many.
auto find_runs = [](const Place& y, const Place& x, const Lines& lines, Run* runs) -> int {
    const int most = lines.columns > LANES ? lines.columns - LANES : 0;
    const int low = __builtin_reduce_min(x.m), high = __builtin_reduce_max(x.p);
    if (high - low < LANES && __builtin_reduce_and(y.i == y.i[0])) {
        runs[0] = {ALL_LANES, 0, low, high, low < most ? low : most};
        return 1;
    }
    const int* rows = (const int*)&y.i;
    int count = 0;
    for (unsigned rest = ALL_LANES; rest; rest &= ~runs[count++].lanes) {
        const int lane = __builtin_ctz(rest);
        const I in_row = (y.i == rows[lane]) & P::lanes_of(rest);
        const int low = __builtin_reduce_min(P::pick(in_row, x.m, I{} + lines.columns));
        const I in_run = in_row & (x.p < low + LANES);
        const int high = __builtin_reduce_max(P::pick(in_run, x.p, I{}));
        const unsigned lanes = P::bits_of(in_run);
        runs[count] = {lanes, __builtin_ctz(lanes), low, high, low < most ? low : most};
    }
    return count;
};
#endif
"""
ROWS = """
#if defined(__AVX512F__) && !defined(__CUDA_ARCH__)
constexpr bool HAS_PERMUTATION = sizeof(F) == 4 && LANES == 16;
typedef float V32 __attribute__((vector_size(64)));
struct Rows {
    static INLINE V read(const F* row, int first, int stride) {
        if (stride == 1) return P::read(row + first);
        V x;
        for (int j = 0; j < LANES; ++j) x[j] = row[(long long)(first + j) * stride];
        return x;
    }
    static INLINE V pick(V row, I at) {
        V32 x;
        __builtin_memcpy(&x, &row, sizeof(V32));
        x = __builtin_ia32_permvarsf512(x, at);
        __builtin_memcpy(&row, &x, sizeof(V32));
        return row;
    }
    // The same, and 0 at places from LANES on.
    static INLINE V pick_any(V row, I at) {
        V32 x;
        __builtin_memcpy(&x, &row, sizeof(V32));
        x = __builtin_ia32_vpermi2varps512(x, at, V32{});
        __builtin_memcpy(&row, &x, sizeof(V32));
        return row;
    }
    static INLINE I pick_any(I from, I at, I other) {
        return __builtin_ia32_vpermi2vard512(from, at, other);
    }
    // Those `lanes` of x that are named by bits, in front of `others`.
    static INLINE I gather_lanes(I x, unsigned lanes, I others) {
        return __builtin_ia32_compresssi512_mask(x, others, (unsigned short)lanes);
    }
};
#else
constexpr bool HAS_PERMUTATION = false;
struct Rows {
    static INLINE V read(const F* row, int, int) { return P::all(row[0]); }
    static INLINE V pick(V row, I) { return row; }
    static INLINE V pick_any(V row, I) { return row; }
    static INLINE I pick_any(I from, I, I) { return from; }
    static INLINE I gather_lanes(I x, unsigned, I) { return x; }
};
#endif
"""
WINDOWS = """
#if !defined(__CUDA_ARCH__)
// What a run sees of fields: its rows, and lanes' columns within its own.
struct Window {
    M is_in;
    I m, i, j, p;
    V a, b;
    long long at_m, at_i, at_j, at_p;
    int first, stride;
    static INLINE Window of(const Run& run, const Place& y, const Place& x, const Lines& lines) {
        Window w;
        w.is_in = __builtin_convertvector(P::lanes_of(run.lanes), M);
        w.first = run.first;
        w.stride = lines.column;
        w.m = x.m - run.first; w.i = x.i - run.first; w.j = x.j - run.first; w.p = x.p - run.first;
        w.a = y.a; w.b = x.a;
        const int l = run.lane;
        w.at_m = (long long)P::lane_of(y.m, l) * lines.row;
        w.at_i = (long long)P::lane_of(y.i, l) * lines.row;
        w.at_j = (long long)P::lane_of(y.j, l) * lines.row;
        w.at_p = (long long)P::lane_of(y.p, l) * lines.row;
        return w;
    }
    V row(const F* f, long long at) const { return Rows::read(f + at, first, stride); }
    V along(V row) const {
        const V one = Rows::pick(row, i);
        return one + b * (Rows::pick(row, j) - one);
    }
    V linear(const F* f) const {
        const V top = along(row(f, at_i));
        return top + a * (along(row(f, at_j)) - top);
    }
    // As `Values::curved`.
    V curved(const F* f, const Place& y, const Place& x, V& bend) const {
        const V row_i = row(f, at_i), row_j = row(f, at_j);
        const V i0 = Rows::pick(row_i, i), i1 = Rows::pick(row_i, j);
        const V j0 = Rows::pick(row_j, i), j1 = Rows::pick(row_j, j);
        const V top = i0 + b * (i1 - i0), low = j0 + b * (j1 - j0);
        const V over = along(row(f, at_m)), under = along(row(f, at_p));
        // Second differences along y, and along x in both rows.
        const V along_y = (F(1) - a) * (over - F(2) * top + low) + a * (top - F(2) * low + under);
        const V in_i = (F(1) - b) * (Rows::pick(row_i, m) - F(2) * i0 + i1)
                     + b * (i0 - F(2) * i1 + Rows::pick(row_i, p));
        const V in_j = (F(1) - b) * (Rows::pick(row_j, m) - F(2) * j0 + j1)
                     + b * (j0 - F(2) * j1 + Rows::pick(row_j, p));
        bend = y.excess * along_y + x.excess * (in_i + a * (in_j - in_i));
        return top + a * (low - top);
    }
};
#endif
"""
