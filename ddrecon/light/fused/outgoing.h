#pragma once
#include "ddrecon/kernels/cells.h"
// E2.3 towards a camera, of light by its moments in angle; `radiance_along` in `light/moments.py`
// is the definition.

namespace ddrecon {

INLINE constexpr double find_root(double x) {
    double root = 1.0 + x;
    for (int i = 0; i < 40; ++i) root = 0.5 * (root + x / root);
    return root;
}
// What makes the mean square of a harmonic 1; and (2 M - 1)!!.
template <int L, int M> constexpr double NORM =
    find_root((M ? 2 : 1) * (2 * L + 1) * factorial(L - M) / factorial(L + M));
template <int M> constexpr double ODD = factorial(2 * M) / (factorial(M) * (1 << M));

// y_k of a vector v, z first, from those of order M and degree L on (`numerics/sphere.py`):
// `cosine` and `sine` are the parts of (x + i y)^M, `legendre` is that of L, `below` that of L - 1.
template <class F, int DEGREE, int M, int L, class N> INLINE void fill_order(
    const N* v, const N& square, const N& cosine, const N& sine, const N& legendre, const N& below,
    N* y) {
    const N value = F(NORM<L, M>) * legendre;
    y[L * L + L + M] = M ? value * cosine : value;
    if constexpr (M > 0) y[L * L + L - M] = value * sine;
    if constexpr (L < DEGREE) {
        const N next = F(2 * L + 1) * v[0] * legendre - F(L + M) * square * below;
        fill_order<F, DEGREE, M, L + 1>(
            v, square, cosine, sine, F(1.0 / (L + 1 - M)) * next, legendre, y);
    }
}
template <class F, int DEGREE, int M = 0, class N>
INLINE void fill_harmonics(const N* v, const N& square, const N& cosine, const N& sine, N* y) {
    fill_order<F, DEGREE, M, M>(v, square, cosine, sine, N(F(ODD<M>)), N(F(0)), y);
    if constexpr (M < DEGREE)
        fill_harmonics<F, DEGREE, M + 1>(
            v, square, v[2] * cosine - v[1] * sine, v[2] * sine + v[1] * cosine, y);
}

// `even` + `along`, floored below a `margin` of their sizes: `floored` in `light/moments.py`.
template <class N> INLINE N size_of(const N& x) {
    return pick(value_of(x) > 0, x, pick(value_of(x) < 0, -x, N(0)));
}
template <class N, class F> INLINE N floored(const N& even, const N& along, F margin, F least) {
    const N r = even + along, size = margin * (size_of(even) + size_of(along));
    const N ratio = r / pick(value_of(size) >= least, size, N(least));
    const N low = pick(value_of(ratio) >= F(-1), ratio, N(F(-1)));
    const N opened = F(1) + pick(value_of(low) <= F(1), low, N(F(1)));
    return pick(value_of(r) >= value_of(size), r, F(0.25) * size * opened * opened);
}

// Where the camera is: at a point, or without `is_eye` in a direction; and what cells see of it.
template <class F> struct View {
    int ny, nx, is_eye;
    F hz, hy, hx, lz, ly, lx, margin, least;

    // Of the first cell in a row.
    INLINE void center_of(const Row& row, F* center) const {
        const long long line = row.start / nx;
        center[0] = lz + hz * (F(line / ny) + F(0.5));
        center[1] = ly + hy * (F(line % ny) + F(0.5));
        center[2] = lx + hx * (F(row.start % nx) + F(0.5));
    }
};

// Light of DEGREE > 0 in angle, its moments of degree l times a factor. Fields are all moments phi,
// and radiance besides (HAS_MORE); numbers are where the camera is, which VARIES, and the factors.
template <int DEGREE, bool HAS_MORE, bool VARIES> struct Outgoing {
    static constexpr int COUNT = (DEGREE + 1) * (DEGREE + 1), INS = COUNT + HAS_MORE;
    static constexpr int LAST = DEGREE;
    static constexpr bool MOVES = VARIES;
    enum { EYE = 0, FACTOR = 3, NUMBERS = 4 + DEGREE };

    // Harmonics towards the camera, at a cell; what moments of each degree add; and what all but
    // the mean do.
    template <class N> struct Directed {
        N y[COUNT], sum[DEGREE + 1], along;
    };
    template <class F, class N, class W, class In> static INLINE void direct(
        const View<F>& view, const F* first, int i, const N* eye, const W* factor, const In* in,
        Directed<N>& seen) {
        N *const y = seen.y, v[3];
        const F center[3] = {first[0], first[1], first[2] + view.hx * F(i)};
        UNROLLED
        for (int a = 0; a < 3; ++a) v[a] = view.is_eye ? eye[a] - center[a] : N(eye[a]);
        const N square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], distance = root(square);
        const bool is_there = value_of(distance) > F(0);
        const N shortened = view.is_eye ? pick(is_there, F(1) / distance, N(F(0))) : N(F(1));
        UNROLLED
        for (int a = 0; a < 3; ++a) v[a] = shortened * v[a];
        fill_harmonics<F, DEGREE>(v, v[0] * v[0] + v[1] * v[1] + v[2] * v[2], N(F(1)), N(F(0)), y);
        seen.along = N(F(0));
        if constexpr (HAS_MORE) seen.along = N(in[COUNT][i]);
        UNROLLED
        for (int l = 1; l <= DEGREE; ++l) {
            seen.sum[l] = N(F(0));
            UNROLLED
            for (int k = l * l; k < (l + 1) * (l + 1); ++k) seen.sum[l] += in[k][i] * y[k];
            seen.along += factor[l] * seen.sum[l];
        }
    }
};

// The radiance in a row; where N are dual numbers, its change.
template <class Cell, class N, class F> INLINE void find_values(
    const Row& row, const View<F>& view, const int* channels, const F* const* fields,
    const F* const* d_fields, const F* numbers, const F* d_numbers, F* const* outputs) {
    const Inputs<N, Cell::INS, Cell::NUMBERS, F> inputs(
        row, channels, fields, d_fields, numbers, d_numbers);
    const N* number = inputs.number;
    F first[3], *radiance = outputs[0] + row.at;
    view.center_of(row, first);
    INDEPENDENT
    for (int i = 0; i < row.width; ++i) {
        const N even = number[Cell::FACTOR] * inputs.in[0][i];
        typename Cell::template Directed<N> seen;
        Cell::direct(view, first, i, number + Cell::EYE, number + Cell::FACTOR, inputs.in, seen);
        radiance[i] = change_of(floored(even, seen.along, view.margin, view.least));
    }
}

// Cotangents of fields, and of numbers `sums` over a row, from that of the radiance.
template <class Cell, class F> INLINE void find_cotangents(
    const Row& row, const View<F>& view, const int* channels, const F* const* fields,
    const F* numbers, const F* const* bars, F* const* outputs, F* sums) {
    REORDERED
    typedef typename If<Cell::MOVES, Dual<F, 3>, F>::type N;
    constexpr int EYE = Cell::EYE, FACTOR = Cell::FACTOR, COUNT = Cell::COUNT;
    const F *in[Cell::INS], *bar = bars[0] + row.at;
    F number[Cell::NUMBERS], sum[Cell::NUMBERS], *out[Cell::INS], first[3];
    row.in_all<Cell::INS>(fields, channels, in);
    row.of_color<Cell::NUMBERS>(numbers, number);
    row.in_all<Cell::INS>(outputs, out);
    view.center_of(row, first);
    const F* const factor = number + FACTOR;
    N eye[3] = {N(number[0]), N(number[1]), N(number[2])};
    if constexpr (Cell::MOVES)
        for (int a = 0; a < 3; ++a) eye[a].by[a] = F(1);
    UNROLLED
    for (int k = 0; k < Cell::NUMBERS; ++k) sum[k] = F(0);
    INDEPENDENT
    for (int i = 0; i < row.width; ++i) {
        typename Cell::template Directed<N> seen;
        Cell::direct(view, first, i, eye, factor, in, seen);
        Dual<F, 2> even(factor[0] * in[0][i]), along(value_of(seen.along));
        even.by[0] = along.by[1] = F(1);
        const Dual<F, 2> radiance = floored(even, along, view.margin, view.least);
        const F even_bar = bar[i] * radiance.by[0], along_bar = bar[i] * radiance.by[1];
        sum[FACTOR] += in[0][i] * even_bar;
        out[0][i] = factor[0] * even_bar;
        UNROLLED
        for (int l = 1; l <= Cell::LAST; ++l) {
            sum[FACTOR + l] += value_of(seen.sum[l]) * along_bar;
            UNROLLED
            for (int k = l * l; k < (l + 1) * (l + 1); ++k)
                out[k][i] = factor[l] * along_bar * value_of(seen.y[k]);
        }
        if constexpr (Cell::INS > COUNT) out[COUNT][i] = along_bar;
        if constexpr (Cell::MOVES)
            for (int a = 0; a < 3; ++a) sum[EYE + a] += along_bar * seen.along.by[a];
    }
    UNROLLED
    for (int k = 0; k < Cell::NUMBERS; ++k) sums[k * row.items + row.item] = sum[k];
}

} // namespace ddrecon
