#pragma once
#include "ddrecon/kernels/dual.h"
// A function of the numbers in one cell, gone through over cells side by side: its values, tangents
// and cotangents. A `Cell` has counts INS, OUTS and NUMBERS, and
//
//     template <class N> INLINE static void find(const N* in, const N* number, N* out);
//
// for any kind of number N: of fields `in`, and of numbers that all cells share.

namespace ddrecon {

template <class Cell, class F>
INLINE void find_values(const F* const* in, const F* number, F* const* out, int count) {
    INDEPENDENT
    for (int i = 0; i < count; ++i) {
        F x[Cell::INS], y[Cell::OUTS];
        UNROLLED
        for (int k = 0; k < Cell::INS; ++k) x[k] = in[k][i];
        Cell::find(x, number, y);
        UNROLLED
        for (int k = 0; k < Cell::OUTS; ++k) out[k][i] = y[k];
    }
}

template <class Cell, class F>
INLINE void find_tangents(
    const F* const* in, const F* const* d_in, const F* number, const F* d_number, F* const* d_out,
    int count) {
    typedef Dual<F> N;
    INDEPENDENT
    for (int i = 0; i < count; ++i) {
        N x[Cell::INS], numbers[Cell::NUMBERS], y[Cell::OUTS];
        UNROLLED
        for (int k = 0; k < Cell::INS; ++k) x[k] = N(in[k][i], d_in[k][i]);
        UNROLLED
        for (int k = 0; k < Cell::NUMBERS; ++k) numbers[k] = N(number[k], d_number[k]);
        Cell::find(x, numbers, y);
        UNROLLED
        for (int k = 0; k < Cell::OUTS; ++k) d_out[k][i] = y[k].by[0];
    }
}

// Dual numbers with a direction for all that is given have the slopes by which cotangents of what
// was found become those of what was given. `number_bar` are sums over these cells.
template <class Cell, class F>
INLINE void find_cotangents(
    const F* const* in, const F* number, const F* const* out_bar, F* const* in_bar, F* number_bar,
    int count) {
    REORDERED
    constexpr int GIVEN = Cell::INS + Cell::NUMBERS;
    typedef Dual<F, GIVEN> N;
    F sum[Cell::NUMBERS];
    UNROLLED
    for (int k = 0; k < Cell::NUMBERS; ++k) sum[k] = F(0);
    INDEPENDENT
    for (int i = 0; i < count; ++i) {
        N x[Cell::INS], numbers[Cell::NUMBERS], y[Cell::OUTS];
        F bar[GIVEN];
        UNROLLED
        for (int k = 0; k < GIVEN; ++k) {
            N& own = k < Cell::INS ? x[k] : numbers[k - Cell::INS];
            own = N(k < Cell::INS ? in[k][i] : number[k - Cell::INS]);
            own.by[k] = F(1);
            bar[k] = F(0);
        }
        Cell::find(x, numbers, y);
        UNROLLED
        for (int o = 0; o < Cell::OUTS; ++o) {
            const F weight = out_bar[o][i];
            UNROLLED
            for (int k = 0; k < GIVEN; ++k) bar[k] += weight * y[o].by[k];
        }
        UNROLLED
        for (int k = 0; k < Cell::INS; ++k) in_bar[k][i] = bar[k];
        UNROLLED
        for (int k = 0; k < Cell::NUMBERS; ++k) sum[k] += bar[Cell::INS + k];
    }
    UNROLLED
    for (int k = 0; k < Cell::NUMBERS; ++k) number_bar[k] = sum[k];
}

} // namespace ddrecon
