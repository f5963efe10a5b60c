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
    // Where the row begins in an array of so many colors, `channels`, which come again and again.
    INLINE long long begin(int channels) const { return color % channels * size + start; }
    // The row in each of COUNT arrays, of all colors or of `channels`.
    template <int COUNT, class P> INLINE void in_all(P* const* arrays, P** rows) const {
        UNROLLED
        for (int k = 0; k < COUNT; ++k) rows[k] = arrays[k] + at;
    }
    template <int COUNT, class P>
    INLINE void in_all(P* const* arrays, const int* channels, P** rows) const {
        UNROLLED
        for (int k = 0; k < COUNT; ++k) rows[k] = arrays[k] + begin(channels[k]);
    }
    template <int COUNT, class F> INLINE void of_color(const F* numbers, F* values) const {
        UNROLLED
        for (int k = 0; k < COUNT; ++k) values[k] = numbers[k * colors + color];
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
            in[k] =
                readable<N>(fields[k], IS_DUAL<N> ? d_fields[k] : nullptr) + row.begin(channels[k]);
        UNROLLED
        for (int k = 0; k < NUMBERS; ++k)
            number[k] = readable<N>(numbers, d_numbers)[k * row.colors + row.color];
    }
};

// The values of a row's cells; where N are dual numbers, their changes.
template <class Cell, class N, class F> INLINE void find_values(
    const Row& row, const int* channels, const F* const* fields, const F* const* d_fields,
    const F* numbers, const F* d_numbers, F* const* outputs) {
    const Inputs<N, Cell::INS, Cell::NUMBERS, F> inputs(
        row, channels, fields, d_fields, numbers, d_numbers);
    F* out[Cell::OUTS];
    row.in_all<Cell::OUTS>(outputs, out);
    INDEPENDENT
    for (int i = 0; i < row.width; ++i) {
        N x[Cell::INS], y[Cell::OUTS];
        UNROLLED
        for (int k = 0; k < Cell::INS; ++k) x[k] = inputs.in[k][i];
        Cell::find(x, inputs.number, y);
        UNROLLED
        for (int k = 0; k < Cell::OUTS; ++k) out[k][i] = change_of(y[k]);
    }
}

// Dual numbers with a direction for each input have the slopes by which cotangents `bars` of the
// outputs become those of inputs: of fields `outputs`, of numbers `sums` over a row.
template <class Cell, class F> INLINE void find_cotangents(
    const Row& row, const int* channels, const F* const* fields, const F* numbers,
    const F* const* bars, F* const* outputs, F* sums) {
    REORDERED
    constexpr int INPUTS = Cell::INS + Cell::NUMBERS;
    typedef Dual<F, INPUTS> N;
    const F *in[Cell::INS], *bar[Cell::OUTS];
    F of_row[Cell::NUMBERS], sum[Cell::NUMBERS], *out[Cell::INS];
    row.in_all<Cell::INS>(fields, channels, in);
    row.of_color<Cell::NUMBERS>(numbers, of_row);
    row.in_all<Cell::OUTS>(bars, bar);
    row.in_all<Cell::INS>(outputs, out);
    UNROLLED
    for (int k = 0; k < Cell::NUMBERS; ++k) sum[k] = F(0);
    INDEPENDENT
    for (int i = 0; i < row.width; ++i) {
        // With one array for fields and numbers the loop would not become vector code.
        N x[Cell::INS], number[Cell::NUMBERS], y[Cell::OUTS];
        F x_bar[INPUTS];
        UNROLLED
        for (int k = 0; k < Cell::INS; ++k) {
            x[k] = N(in[k][i]);
            x[k].by[k] = F(1);
        }
        UNROLLED
        for (int k = 0; k < Cell::NUMBERS; ++k) {
            number[k] = N(of_row[k]);
            number[k].by[Cell::INS + k] = F(1);
        }
        Cell::find(x, number, y);
        UNROLLED
        for (int k = 0; k < INPUTS; ++k) {
            x_bar[k] = F(0);
            UNROLLED
            for (int o = 0; o < Cell::OUTS; ++o) x_bar[k] += bar[o][i] * y[o].by[k];
        }
        UNROLLED
        for (int k = 0; k < Cell::INS; ++k) out[k][i] = x_bar[k];
        UNROLLED
        for (int k = 0; k < Cell::NUMBERS; ++k) sum[k] += x_bar[Cell::INS + k];
    }
    UNROLLED
    for (int k = 0; k < Cell::NUMBERS; ++k) sums[k * row.items + row.item] = sum[k];
}

} // namespace ddrecon
