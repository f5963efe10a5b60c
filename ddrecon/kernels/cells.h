#pragma once
#include "ddrecon/kernels/dual.h"
// A function of the numbers in one cell, gone through over cells side by side: its values, tangents
// and cotangents. A `Cell` has counts INS, OUTS and NUMBERS, and
//
//     template <class N> INLINE static void find(const N* in, const N* number, N* out);
//
// for any kind of number N: of fields `in`, and of numbers that all cells of a color share.

namespace ddrecon {

// What an item does: one of the `rows` of a color, of `width` cells.
struct Row {
    int width, color, colors;
    long long item, items, size, start, at;
    INLINE Row(int item, int width, int rows, int colors)
        : width(width),
          color(item / rows),
          colors(colors),
          item(item),
          items((long long)rows * colors),
          size((long long)rows * width),
          start((long long)(item % rows) * width),
          at((long long)item * width) {}
    // The row in each of COUNT arrays; those of fewer colors, `channels`, come again and again.
    template <int COUNT, class P> INLINE void in_all(P* const* arrays, P** found) const {
        UNROLLED
        for (int k = 0; k < COUNT; ++k) found[k] = arrays[k] + at;
    }
    template <int COUNT, class P>
    INLINE void in_all(P* const* arrays, const int* channels, P** found) const {
        UNROLLED
        for (int k = 0; k < COUNT; ++k) found[k] = arrays[k] + (color % channels[k] * size + start);
    }
    template <int COUNT, class F> INLINE void of_color(const F* numbers, F* found) const {
        UNROLLED
        for (int k = 0; k < COUNT; ++k) found[k] = numbers[k * colors + color];
    }
};

// What an item reads as numbers N: of fields its row, and numbers of its color.
template <class N, int INS, int NUMBERS, class F> struct Inputs {
    decltype(readable<N>((const F*)0, (const F*)0)) in[INS];
    N number[NUMBERS];
    INLINE Inputs(
        const Row& row, const int* channels, const F* const* fields, const F* const* d_fields,
        const F* numbers, const F* d_numbers) {
        UNROLLED
        for (int k = 0; k < INS; ++k)
            in[k] = readable<N>(fields[k], IS_DUAL<N> ? d_fields[k] : nullptr) +
                    (row.color % channels[k] * row.size + row.start);
        UNROLLED
        for (int k = 0; k < NUMBERS; ++k)
            number[k] = readable<N>(numbers, d_numbers)[k * row.colors + row.color];
    }
};

// What is found in a row; where N are dual numbers, its change.
template <class Cell, class N, class F> INLINE void find_values(
    const Row& row, const int* channels, const F* const* fields, const F* const* d_fields,
    const F* numbers, const F* d_numbers, F* const* made) {
    const Inputs<N, Cell::INS, Cell::NUMBERS, F> given(
        row, channels, fields, d_fields, numbers, d_numbers);
    F* out[Cell::OUTS];
    row.in_all<Cell::OUTS>(made, out);
    INDEPENDENT
    for (int i = 0; i < row.width; ++i) {
        N x[Cell::INS], y[Cell::OUTS];
        UNROLLED
        for (int k = 0; k < Cell::INS; ++k) x[k] = given.in[k][i];
        Cell::find(x, given.number, y);
        UNROLLED
        for (int k = 0; k < Cell::OUTS; ++k) out[k][i] = change_of(y[k]);
    }
}

// Dual numbers with a direction for all that is given have the slopes by which cotangents `bars` of
// what was found become those of what was given: of fields `made`, of numbers `sums` over a row.
template <class Cell, class F> INLINE void find_cotangents(
    const Row& row, const int* channels, const F* const* fields, const F* numbers,
    const F* const* bars, F* const* made, F* sums) {
    REORDERED
    constexpr int GIVEN = Cell::INS + Cell::NUMBERS;
    typedef Dual<F, GIVEN> N;
    const F *in[Cell::INS], *bar[Cell::OUTS];
    F number[Cell::NUMBERS], sum[Cell::NUMBERS], *out[Cell::INS];
    row.in_all<Cell::INS>(fields, channels, in);
    row.of_color<Cell::NUMBERS>(numbers, number);
    row.in_all<Cell::OUTS>(bars, bar);
    row.in_all<Cell::INS>(made, out);
    UNROLLED
    for (int k = 0; k < Cell::NUMBERS; ++k) sum[k] = F(0);
    INDEPENDENT
    for (int i = 0; i < row.width; ++i) {
        N x[Cell::INS], own[Cell::NUMBERS], y[Cell::OUTS];
        F found[GIVEN];
        UNROLLED
        for (int k = 0; k < Cell::INS; ++k) {
            x[k] = N(in[k][i]);
            x[k].by[k] = F(1);
        }
        UNROLLED
        for (int k = 0; k < Cell::NUMBERS; ++k) {
            own[k] = N(number[k]);
            own[k].by[Cell::INS + k] = F(1);
        }
        Cell::find(x, own, y);
        UNROLLED
        for (int k = 0; k < GIVEN; ++k) {
            found[k] = F(0);
            UNROLLED
            for (int o = 0; o < Cell::OUTS; ++o) found[k] += bar[o][i] * y[o].by[k];
        }
        UNROLLED
        for (int k = 0; k < Cell::INS; ++k) out[k][i] = found[k];
        UNROLLED
        for (int k = 0; k < Cell::NUMBERS; ++k) sum[k] += found[Cell::INS + k];
    }
    UNROLLED
    for (int k = 0; k < Cell::NUMBERS; ++k) sums[k * row.items + row.item] = sum[k];
}

} // namespace ddrecon
