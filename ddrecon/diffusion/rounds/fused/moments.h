#pragma once
#include "ddrecon/diffusion/rounds/fused/lines.h"
// Rows of moments from rows of radiance along directions, and the other way around (E2.8): products
// of small matrices with rows. A direction and its mirror image in x, a pair, share sums over
// moments even and odd in x.

namespace ddrecon {

// So many at once, R or one: `step` is told how many, and the first.
template <int N> struct Block {
    static constexpr int size = N;
};
template <int R, class Step> INLINE void in_blocks(int count, Step step) {
    int i = 0;
    if constexpr (R > 1)
        for (; i + R <= count; i += R) step(Block<R>(), i);
    for (; i < count; ++i) step(Block<1>(), i);
}

// Radiance at cells of a row, by its pairs. The second of a pair is -1 where there is none.
template <class F> struct Pairs {
    const int* places;
    int count;
    F *lines, *copies;
    long long stride, pitch;
    INLINE F* copied(int k) const { return copies + k * pitch; }
    INLINE bool is_one(int p) const { return places[2 * p + 1] < 0; }
    INLINE F* one(int p) const { return lines + places[2 * p] * stride; }
    INLINE F* other(int p) const { return lines + places[2 * p + 1] * stride; }
};

// A moment of light; light is given as mean, flux along z, y, x, and what is higher, each of `all`
// colors and cells.
template <class F> INLINE const F* part_of(const F* const* parts, int k, long long all) {
    const int places[4] = {0, 2, 1, 3};
    return k < 4 ? parts[places[k]] : parts[4] ? parts[4] + (k - 4) * all : nullptr;
}

// Of moments to a DEGREE, those even in x come first. Few stay in registers. Many rows, which lie
// far apart, take each other's places in a cache: they are copied one after another to where they
// do not, and each that is read counts for some pairs at once.
template <int DEGREE> struct Order {
    static constexpr int EVEN = (DEGREE + 1) * (DEGREE + 2) / 2, ODD = DEGREE * (DEGREE + 1) / 2;
    static constexpr int COUNT = EVEN + ODD;
    static constexpr bool ARE_MANY = COUNT > 16;
};
// Sums of rows, each by a number, for each moment.
template <class F, int COUNT, int TERMS> struct Sums {
    const F* rows[COUNT][TERMS];
    F by[COUNT][TERMS];
    template <class T> INLINE T at(int k, int c, long long ahead) const {
        T sum{};
        UNROLLED
        for (int i = 0; i < TERMS; ++i) {
            sum += by[k][i] * read<T>(rows[k][i] + c);
            if (sizeof(T) > sizeof(F)) __builtin_prefetch(rows[k][i] + ahead + c);
        }
        return sum;
    }
};

// Radiance of pairs from moments that are sums; rows are `ahead` of the next ones, which are asked
// for in time.
template <int DEGREE, int TERMS, class F> __attribute__((noinline)) void to_directions(
    const F* matrix, const Sums<F, Order<DEGREE>::COUNT, TERMS>& sums, const Pairs<F>& pairs,
    long long ahead, int from, int to) {
    typedef Order<DEGREE> Own;
    for (int k = 0; Own::ARE_MANY && k < Own::COUNT; ++k)
        in_steps<F>(from, to, [&](auto none, int c) HERE {
            write(pairs.copied(k) + c, sums.template at<decltype(none)>(k, c, ahead));
        });
    in_steps<F>(from, to, [&](auto none, int c) HERE {
        typedef decltype(none) T;
        T in[Own::COUNT];
        UNROLLED
        for (int k = 0; k < Own::COUNT; ++k)
            if constexpr (Own::ARE_MANY)
                in[k] = read<T>(pairs.copied(k) + c);
            else
                in[k] = sums.template at<T>(k, c, ahead);
        in_blocks<Own::ARE_MANY ? 4 : 1>(pairs.count, [&](auto block, int p) HERE {
            constexpr int R = decltype(block)::size;
            T sum[R], difference[R];
            UNROLLED
            for (int a = 0; a < R; ++a) sum[a] = difference[a] = none;
            UNROLLED
            for (int k = 0; k < Own::COUNT; ++k) {
                T* const found = k < Own::EVEN ? sum : difference;
                UNROLLED
                for (int a = 0; a < R; ++a) found[a] += matrix[(p + a) * Own::COUNT + k] * in[k];
            }
            UNROLLED
            for (int a = 0; a < R; ++a) {
                write(pairs.one(p + a) + c, sum[a] + difference[a]);
                if (!pairs.is_one(p + a)) write(pairs.other(p + a) + c, sum[a] - difference[a]);
            }
        });
    });
}

// The transpose: moments that `found` rows get, or what is added to them. Those that nothing is in
// yet begin with `first` in the mean, less the rows `taken`.
template <int DEGREE, class F> __attribute__((noinline)) void to_moments(
    const F* matrix, F* const* found, const F* const* taken, F first, bool is_adding,
    const Pairs<F>& pairs, long long ahead, int width) {
    typedef Order<DEGREE> Own;
    auto begin = [&](auto none, int k, int c) HERE {
        typedef decltype(none) T;
        if (!is_adding) return (k ? F(0) : first) - read<T>(taken[k] + c);
        if (sizeof(T) > sizeof(F)) __builtin_prefetch(found[k] + ahead + c);
        return read<T>(found[k] + c);
    };
    in_steps<F>(0, width, [&](auto none, int c) HERE {
        typedef decltype(none) T;
        T out[Own::COUNT];
        UNROLLED
        for (int k = 0; k < Own::COUNT; ++k) out[k] = Own::ARE_MANY ? none : begin(none, k, c);
        in_blocks<Own::ARE_MANY ? 4 : 1>(pairs.count, [&](auto block, int p) HERE {
            constexpr int R = decltype(block)::size;
            T sum[R], difference[R];
            UNROLLED
            for (int a = 0; a < R; ++a) {
                sum[a] = difference[a] = read<T>(pairs.one(p + a) + c);
                if (pairs.is_one(p + a)) continue;
                const T other = read<T>(pairs.other(p + a) + c);
                sum[a] += other;
                difference[a] -= other;
            }
            UNROLLED
            for (int k = 0; k < Own::COUNT; ++k) {
                const T* const given = k < Own::EVEN ? sum : difference;
                UNROLLED
                for (int a = 0; a < R; ++a) out[k] += matrix[k * pairs.count + p + a] * given[a];
            }
        });
        UNROLLED
        for (int k = 0; k < Own::COUNT; ++k)
            write((Own::ARE_MANY ? pairs.copied(k) : found[k]) + c, out[k]);
    });
    for (int k = 0; Own::ARE_MANY && k < Own::COUNT; ++k)
        in_steps<F>(0, width, [&](auto none, int c) HERE {
            write(found[k] + c, begin(none, k, c) + read<decltype(none)>(pairs.copied(k) + c));
        });
}

} // namespace ddrecon
