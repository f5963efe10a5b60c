#pragma once
#include "ddrecon/transport/fused/lines.h"
// Rows of moments from rows of radiance along directions, and the other way around (E2.8): products
// of small matrices with rows. A direction and its mirror images in x, in y and in both, a unit,
// share the sums over moments of each parity: these are sums of the four with different signs.

namespace ddrecon {

// Radiance at cells of a row, by its units: places of the four among directions, of which `ups` go
// up in y and have lines of their own; -1 for none.
template <class F> struct Units {
    const int* places;
    int count, ups;
    F *lines[2], *copies;
    long long stride, pitch;
    INLINE F* copied(int k) const { return copies + k * pitch; }
};
// The lines of some units from one on, null for none.
template <class F> struct Block {
    static constexpr int SIZE = 2;
    F* lines[SIZE][4];

    INLINE Block(const Units<F>& units, int first) {
        for (int n = 0; n < 4 * SIZE; ++n) {
            const int j = units.places[4 * first + n];
            lines[n / 4][n % 4] = j < 0 ? nullptr : units.lines[j >= units.ups] + j * units.stride;
        }
    }
};

// Moment k of light, each of `all` colors and cells; null for none. Light is given as moments of
// degrees 0 and 1, so many `low` ones, and those of higher degree.
template <class F> INLINE const F* moment_of(const F* const* phi, int low, int k, long long all) {
    if (k < 4) return phi[0] && k < low ? phi[0] + k * all : nullptr;
    return phi[1] ? phi[1] + (k - 4) * all : nullptr;
}

// Of moments to a DEGREE, those of parity p (even in y before odd, of each even in x before
// odd) end before ENDS[p]: there are DEGREE + 1 - m of order m, odd in one of them where m is odd,
// and as many of order -m, which are odd in the other.
template <int DEGREE> struct Order {
    static constexpr int COUNT = (DEGREE + 1) * (DEGREE + 1);
    static constexpr int ODD = (DEGREE + 1) / 2 * (DEGREE / 2 + 1);
    static constexpr int BOTH = DEGREE / 2 * ((DEGREE + 1) / 2);
    static constexpr int ENDS[5] = {
        0, COUNT - 2 * ODD - BOTH, COUNT - ODD - BOTH, COUNT - BOTH, COUNT};
};
// Sums of rows, each by a number, for each moment.
template <class F, int COUNT, int TERMS> struct Sums {
    const F* rows[COUNT][TERMS];
    F by[COUNT][TERMS];
};

// Sums and differences of four, first along x: values by parity from those of images, and back.
template <class T> INLINE void mirror(T* x) {
    const T even = x[0] + x[1], odd = x[0] - x[1], other_even = x[2] + x[3], other = x[2] - x[3];
    x[0] = even + other_even;
    x[1] = odd + other;
    x[2] = even - other_even;
    x[3] = odd - other;
}

// Radiance of units from moments that are sums. Rows of these lie far apart and take each other's
// places in a cache: they are copied one after another to where they do not, and the next ones are
// asked for in time.
template <int DEGREE, int TERMS, class F> __attribute__((noinline)) void to_directions(
    const F* matrix, const Sums<F, Order<DEGREE>::COUNT, TERMS>& sums, const Units<F>& units,
    long long ahead, int from, int to) {
    typedef Order<DEGREE> Own;
    constexpr int R = Block<F>::SIZE;
    for (int k = 0; k < Own::COUNT; ++k)
        in_steps<F>(from, to, [&](auto none, int c) HERE {
            typedef decltype(none) T;
            T sum = none;
            UNROLLED
            for (int i = 0; i < TERMS; ++i) {
                sum += sums.by[k][i] * read<T>(sums.rows[k][i] + c);
                if (sizeof(T) > sizeof(F)) __builtin_prefetch(sums.rows[k][i] + ahead + c);
            }
            write(units.copied(k) + c, sum);
        });
    for (int u = 0; u < units.count; u += R) {
        const Block<F> block(units, u);
        in_steps<F>(from, to, [&](auto none, int c) HERE {
            typedef decltype(none) T;
            T found[R][4];
            UNROLLED
            for (int p = 0; p < 4; ++p) {
                T sum[R];
                UNROLLED
                for (int a = 0; a < R; ++a) sum[a] = none;
                for (int k = Own::ENDS[p]; k < Own::ENDS[p + 1]; ++k) {
                    const T moment = read<T>(units.copied(k) + c);
                    UNROLLED
                    for (int a = 0; a < R; ++a) sum[a] += matrix[k * units.count + u + a] * moment;
                }
                UNROLLED
                for (int a = 0; a < R; ++a) found[a][p] = sum[a];
            }
            UNROLLED
            for (int a = 0; a < R; ++a) {
                mirror(found[a]);
                UNROLLED
                for (int i = 0; i < 4; ++i)
                    if (F* line = block.lines[a][i]) write(line + c, found[a][i]);
            }
        });
    }
}

// The transpose: moments that `found` rows get, or what is added to them. Those that nothing is in
// yet begin with `first` in the mean, less the rows `taken`.
template <int DEGREE, class F> __attribute__((noinline)) void to_moments(
    const F* matrix, F* const* found, const F* const* taken, F first, bool is_adding,
    const Units<F>& units, long long ahead, int width) {
    typedef Order<DEGREE> Own;
    constexpr int R = Block<F>::SIZE;
    for (int u = 0; u < units.count; u += R) {
        const Block<F> block(units, u);
        in_steps<F>(0, width, [&](auto none, int c) HERE {
            typedef decltype(none) T;
            T given[R][4];
            UNROLLED
            for (int a = 0; a < R; ++a) {
                UNROLLED
                for (int i = 0; i < 4; ++i) {
                    const F* line = block.lines[a][i];
                    given[a][i] = line ? read<T>(line + c) : none;
                }
                mirror(given[a]);
            }
            UNROLLED
            for (int p = 0; p < 4; ++p)
                for (int k = Own::ENDS[p]; k < Own::ENDS[p + 1]; ++k) {
                    T sum = u ? read<T>(units.copied(k) + c) : none;
                    UNROLLED
                    for (int a = 0; a < R; ++a)
                        sum += matrix[k * units.count + u + a] * given[a][p];
                    write(units.copied(k) + c, sum);
                }
        });
    }
    for (int k = 0; k < Own::COUNT; ++k)
        in_steps<F>(0, width, [&](auto none, int c) HERE {
            typedef decltype(none) T;
            T sum = read<T>(units.copied(k) + c);
            if (is_adding) {
                if (sizeof(T) > sizeof(F)) __builtin_prefetch(found[k] + ahead + c);
                sum += read<T>(found[k] + c);
            } else {
                sum += (k ? F(0) : first) - read<T>(taken[k] + c);
            }
            write(found[k] + c, sum);
        });
}

} // namespace ddrecon
