"""C++ of packets of rays: where a node lies among cells, and the values there.

As `lines` and `planes` have it for one ray: linear interpolation in a slice, beams' masses to third
order. Fields are read in place, by strides.
"""

PLACES = """
// Lines of cells across the packet, along which its rays are close to each other (y), and along it
// (x): sizes, and strides in memory.
struct Lines { int rows, columns, row, column; };
// The cells m, i, j, p around a place on a line, which lies a part a of the way from i to j.
struct Place {
    I m, i, j, p;
    V a, excess;
    INLINE Place at(V y, int size) {
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
};
// The four cells around a place in a slice, and their weights.
struct Corners {
    I at00, at01, at10, at11;
    V w00, w01, w10, w11;
    INLINE Corners of(const Place& y, const Place& x, const Lines& lines) {
        Corners q;
        const I yi = y.i * lines.row, yj = y.j * lines.row;
        const I xi = x.i * lines.column, xj = x.j * lines.column;
        q.at00 = yi + xi; q.at01 = yi + xj; q.at10 = yj + xi; q.at11 = yj + xj;
        q.w11 = y.a * x.a;
        q.w10 = y.a - q.w11;
        q.w01 = x.a - q.w11;
        q.w00 = (F(1) - y.a) - q.w01;
        return q;
    }
};
"""
RUNS = """
#if !defined(__CUDA_ARCH__)
// Lanes `begin` to before `end`, whose nodes lie between the same two rows, and in columns `low` to
// `high`, all within LANES columns from `first` on.
struct Run { int begin, end, low, high, first; };
// The runs of a packet; how many.
auto find_runs = [](const Place& y, const Place& x, const Lines& lines, Run* runs) -> int {
    const int most = lines.columns > LANES ? lines.columns - LANES : 0;
    const int low = __builtin_reduce_min(x.m), high = __builtin_reduce_max(x.p);
    if (high - low < LANES && __builtin_reduce_and(y.i == y.i[0])) {
        runs[0] = {0, LANES, low, high, low < most ? low : most};
        return 1;
    }
    const int *xm = (const int*)&x.m, *xp = (const int*)&x.p, *yi = (const int*)&y.i;
    int count = 0;
    for (int begin = 0, end; begin < LANES; begin = end) {
        int low = xm[begin], high = xp[begin];
        for (end = begin + 1; end < LANES; ++end) {
            const int lower = xm[end] < low ? xm[end] : low;
            const int higher = xp[end] > high ? xp[end] : high;
            if (yi[end] != yi[begin] || higher - lower >= LANES) break;
            low = lower;
            high = higher;
        }
        runs[count++] = {begin, end, low, high, low < most ? low : most};
    }
    return count;
};
#endif
"""
# Of a run, columns of a row are read in one piece, and lanes pick theirs by a permutation.
ROWS = """
#if defined(__AVX512F__) && !defined(__CUDA_ARCH__)
constexpr bool HAS_PERMUTATION = sizeof(F) == 4 && LANES == 16;
typedef float V32 __attribute__((vector_size(64)));
struct Rows {
    INLINE V read(const F* row, int first, int stride) {
        V x;
        if (stride == 1) __builtin_memcpy(&x, row + first, sizeof(V));
        else for (int j = 0; j < LANES; ++j) x[j] = row[(long long)(first + j) * stride];
        return x;
    }
    INLINE V pick(V row, I at) {
        V32 x;
        __builtin_memcpy(&x, &row, sizeof(V32));
        x = __builtin_ia32_permvarsf512(x, at);
        __builtin_memcpy(&row, &x, sizeof(V32));
        return row;
    }
};
#else
constexpr bool HAS_PERMUTATION = false;
struct Rows {
    INLINE V read(const F* row, int, int) { return P::all(row[0]); }
    INLINE V pick(V row, I) { return row; }
};
#endif
"""
VALUES = """
struct Values {
    INLINE V linear(const F* f, const Corners& q) {
        return q.w00 * P::gather(f, q.at00) + q.w01 * P::gather(f, q.at01)
             + q.w10 * P::gather(f, q.at10) + q.w11 * P::gather(f, q.at11);
    }
    // The linear value, and in `bend` what it is off by: a (1 - a) / 2 second differences an axis.
    INLINE V curved(
        const F* f, const Corners& q, const Place& y, const Place& x, const Lines& lines, V& bend
    ) {
        const I ym = y.m * lines.row, yi = y.i * lines.row, yj = y.j * lines.row;
        const I yp = y.p * lines.row, xm = x.m * lines.column, xi = x.i * lines.column;
        const I xj = x.j * lines.column, xp = x.p * lines.column;
        const V f00 = P::gather(f, q.at00), f01 = P::gather(f, q.at01);
        const V f10 = P::gather(f, q.at10), f11 = P::gather(f, q.at11);
        const V along_y = q.w00 * (P::gather(f, ym + xi) - F(2) * f00 + f10)
                        + q.w01 * (P::gather(f, ym + xj) - F(2) * f01 + f11)
                        + q.w10 * (f00 - F(2) * f10 + P::gather(f, yp + xi))
                        + q.w11 * (f01 - F(2) * f11 + P::gather(f, yp + xj));
        const V along_x = q.w00 * (P::gather(f, yi + xm) - F(2) * f00 + f01)
                        + q.w10 * (P::gather(f, yj + xm) - F(2) * f10 + f11)
                        + q.w01 * (f00 - F(2) * f01 + P::gather(f, yi + xp))
                        + q.w11 * (f10 - F(2) * f11 + P::gather(f, yj + xp));
        bend = y.excess * along_y + x.excess * along_x;
        return q.w00 * f00 + q.w01 * f01 + q.w10 * f10 + q.w11 * f11;
    }
};
"""
