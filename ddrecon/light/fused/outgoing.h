#pragma once
#include "ddrecon/kernels/dual.h"
// E3 towards a camera, of light by its moments in angle; `Moments.positive_along` is the
// definition.

namespace ddrecon {

INLINE constexpr double find_root(double x) {
    double found = 1.0 + x;
    for (int i = 0; i < 40; ++i) found = 0.5 * (found + x / found);
    return found;
}
// What makes the mean square of a harmonic 1; and (2 M - 1)!!.
template <int L, int M> constexpr double NORM =
    find_root((M ? 2 : 1) * (2 * L + 1) * FACTORIAL<L - M> / FACTORIAL<L + M>);
template <int M> constexpr double ODD = FACTORIAL<2 * M> / (FACTORIAL<M> * (1 << M));

// y_k of a vector v, z first, from those of order M and degree L on (`numerics/harmonics.py`):
// `cosine` and `sine` are the parts of (x + i y)^M, `legendre` is that of L, `before` that of L
// - 1.
template <class F, int DEGREE, int M, int L, class N> INLINE void fill_order(
    const N* v, const N& square, const N& cosine, const N& sine, const N& legendre, const N& before,
    N* y) {
    const N value = F(NORM<L, M>) * legendre;
    y[L * L + L + M] = M ? value * cosine : value;
    if constexpr (M > 0) y[L * L + L - M] = value * sine;
    if constexpr (L < DEGREE) {
        const N next = F(2 * L + 1) * v[0] * legendre - F(L + M) * square * before;
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

// `even` + `along`, bent to zero below a `margin` of their sizes; with its slopes by both.
template <class F> struct Bent {
    F value, by_even, by_along;
    INLINE Bent(F even, F along, F margin, F least) {
        const F r = even + along, size = margin * (size_of(even) + size_of(along));
        const F divisor = size > least ? size : least, part = r / divisor;
        const F opened = F(1) + (part < F(-1) ? F(-1) : (part > F(1) ? F(1) : part));
        const bool is_inside = (r >= -divisor) & (r <= divisor), is_whole = r >= size;
        const F slope = is_inside ? F(0.5) * opened * (size / divisor) : F(0);
        const F moved = size >= least ? slope * part : F(0);
        const F by_size = is_whole ? F(0) : margin * (F(0.25) * opened * opened - moved);
        value = is_whole ? r : F(0.25) * size * opened * opened;
        by_even = (is_whole ? F(1) : slope) + by_size * sign_of(even);
        by_along = (is_whole ? F(1) : slope) + by_size * sign_of(along);
    }
    static INLINE F size_of(F x) { return x < F(0) ? -x : x; }
    static INLINE F sign_of(F x) { return x < F(0) ? F(-1) : (x > F(0) ? F(1) : F(0)); }
};
template <class F> INLINE F bent(F even, F along, F margin, F least) {
    return Bent<F>(even, along, margin, least).value;
}
template <class F>
INLINE Dual<F> bent(const Dual<F>& even, const Dual<F>& along, F margin, F least) {
    const Bent<F> found(even.value, along.value, margin, least);
    return even.chain(found.value, found.by_even, along, found.by_along);
}

// Light of DEGREE in angle: moments of degree l count times `factors` [DEGREE + 1, colors]. An item
// is `width` cells of a row in one color. The camera is at a point, or without `is_eye` in a
// direction.
template <class F, int DEGREE, bool HAS_MORE> struct Outgoing {
    int nz, ny, nx, width, is_eye, colors, mean_colors, flux_colors, higher_colors;
    F hz, hy, hx, lz, ly, lx, margin, least;
    static constexpr int COUNT = (DEGREE + 1) * (DEGREE + 1);

    static INLINE int degree_of(int k) {
        return (k > 0) + (k > 3) + (k > 8) + (k > 15) + (k > 24) + (k > 35) + (k > 48);
    }

    struct Row {
        int color;
        long long size, start;
        F z, y, x;
    };
    INLINE Row row_of(int item) const {
        const int parts = nx / width, rows = nz * ny, c = item / (rows * parts);
        const int row = item / parts - c * rows, begin = item % parts * width;
        const F z = lz + hz * (F(row / ny) + F(0.5)), y = ly + hy * (F(row % ny) + F(0.5));
        return {c, (long long)rows * nx,         (long long)row * nx + begin, z,
                y, lx + hx * (F(begin) + F(0.5))};
    }

    // A row of light: `arrays` are the mean, the flux along z, y and x, all higher moments one
    // after the other, and radiance besides, which has all colors.
    template <class In> struct Light {
        In first[4], higher, more;
        long long step;
        INLINE decltype(auto) operator()(int k, int i) const {
            return k < 4 ? first[k][i] : higher[(k - 4) * step + i];
        }
    };
    template <class Arrays> INLINE auto light_of(
        const Row& row, const Arrays& arrays, int mean_colors, int flux_colors,
        int higher_colors) const {
        auto own = [&](int k, int colors) HERE {
            return arrays(k) + (colors > 1 ? row.color * row.size + row.start : row.start);
        };
        Light<decltype(own(0, 1))> found = {};
        found.step = higher_colors * row.size;
        UNROLLED
        for (int k = 0; k < (DEGREE > 0 ? 4 : 1); ++k)
            found.first[k] = own(k, k > 0 ? flux_colors : mean_colors);
        if constexpr (DEGREE > 1) found.higher = own(4, higher_colors);
        if constexpr (HAS_MORE) found.more = own(5, colors);
        return found;
    }

    // Harmonics towards the camera, where those of degree 1 are a unit vector, at cell i of a row;
    // what moments of each degree add; and what all but the mean do.
    template <class N> struct Directed {
        N y[COUNT], sum[DEGREE + 1], along;
    };
    template <class N, class P, class W, class In> INLINE void direct(
        const Row& row, int i, const P* point, const W* factor, const Light<In>& light,
        Directed<N>& found) const {
        N *const y = found.y, v[3];
        const F center[3] = {row.z, row.y, row.x + hx * F(i)};
        UNROLLED
        for (int a = 0; a < 3; ++a) v[a] = is_eye ? point[a] - center[a] : N(point[a]);
        const N square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], distance = root(square);
        const bool is_there = value_of(distance) > F(0);
        const N shortened = is_eye ? pick(is_there, F(1) / distance, N(F(0))) : N(F(1));
        UNROLLED
        for (int a = 0; a < 3; ++a) v[a] = shortened * v[a];
        if constexpr (DEGREE > 1)
            fill_harmonics<F, DEGREE>(
                v, v[0] * v[0] + v[1] * v[1] + v[2] * v[2], N(F(1)), N(F(0)), y);
        found.along = N(F(0));
        if constexpr (HAS_MORE) found.along = N(light.more[i]);
        UNROLLED
        for (int l = 1; l <= DEGREE; ++l) {
            found.sum[l] = N(F(0));
            UNROLLED
            for (int k = l * l; k < (l + 1) * (l + 1); ++k) {
                if (l == 1) y[k] = v[k - 1];
                found.sum[l] += light(k, i) * y[k];
            }
            found.along += factor[l] * found.sum[l];
        }
    }

    template <class N, class In, class Arrays> INLINE void scatter(
        int item, const In& point, const In& factors, const Arrays& arrays, F* radiance) const {
        const Row row = row_of(item);
        const auto light = light_of(row, arrays, mean_colors, flux_colors, higher_colors);
        const N eye[3] = {point[0], point[1], point[2]};
        N factor[DEGREE + 1];
        UNROLLED
        for (int l = 0; l <= DEGREE; ++l) factor[l] = factors[l * colors + row.color];
        F* out = radiance + row.color * row.size + row.start;
        INDEPENDENT
        for (int i = 0; i < width; ++i) {
            const N even = factor[0] * light(0, i);
            if constexpr (DEGREE > 0) {
                Directed<N> found;
                direct(row, i, eye, factor, light, found);
                out[i] = change_of(bent(even, found.along, margin, least));
            } else {
                out[i] = change_of(pick(value_of(even) < F(0), N(F(0)), even));
            }
        }
    }

    // Cotangents in all colors; of factors and of the point, if it varies, `sums` of each item.
    template <bool POINT_VARIES> INLINE void scatter_back(
        int item, const F* point, const F* factors, const F* const* arrays, const F* radiance_bar,
        F* const* bars, F* sums) const {
        REORDERED
        typedef typename If<POINT_VARIES, Dual<F, 3>, F>::type N;
        const Row row = row_of(item);
        const auto light = light_of(
            row, [&](int k) HERE { return arrays[k]; }, mean_colors, flux_colors, higher_colors);
        const auto light_bar =
            light_of(row, [&](int k) HERE { return bars[k]; }, colors, colors, colors);
        const F* bar = radiance_bar + row.color * row.size + row.start;
        N eye[3] = {N(point[0]), N(point[1]), N(point[2])};
        if constexpr (POINT_VARIES)
            for (int a = 0; a < 3; ++a) eye[a].by[a] = F(1);
        F factor[DEGREE + 1], factor_bar[DEGREE + 1], eye_bar[3] = {F(0), F(0), F(0)};
        UNROLLED
        for (int l = 0; l <= DEGREE; ++l) {
            factor[l] = factors[l * colors + row.color];
            factor_bar[l] = F(0);
        }
        const int count = width;
        INDEPENDENT
        for (int i = 0; i < count; ++i) {
            Directed<N> found;
            const F even = factor[0] * light(0, i);
            F even_bar = even < F(0) ? F(0) : bar[i], along_bar = F(0);
            if constexpr (DEGREE > 0) {
                direct(row, i, eye, factor, light, found);
                const Bent<F> whole(even, value_of(found.along), margin, least);
                even_bar = bar[i] * whole.by_even;
                along_bar = bar[i] * whole.by_along;
            }
            factor_bar[0] += light(0, i) * even_bar;
            light_bar(0, i) = factor[0] * even_bar;
            UNROLLED
            for (int l = 1; l <= DEGREE; ++l) factor_bar[l] += value_of(found.sum[l]) * along_bar;
            UNROLLED
            for (int k = 1; k < COUNT; ++k)
                light_bar(k, i) = factor[degree_of(k)] * along_bar * value_of(found.y[k]);
            if constexpr (HAS_MORE) light_bar.more[i] = along_bar;
            if constexpr (POINT_VARIES && DEGREE > 0)
                for (int a = 0; a < 3; ++a) eye_bar[a] += along_bar * found.along.by[a];
        }
        const long long items = (long long)colors * nz * ny * (nx / width);
        UNROLLED
        for (int l = 0; l <= DEGREE; ++l) sums[l * items + item] = factor_bar[l];
        for (int a = 0; a < 3; ++a) sums[(DEGREE + 1 + a) * items + item] = eye_bar[a];
    }
};

} // namespace ddrecon
