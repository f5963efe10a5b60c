#pragma once
#include "ddrecon/kernels/numbers.h"

namespace ddrecon {

// A row of a field, of all its channels, to where there are empty cells around it; of the row, from
// where to where there are cells that are not empty, and the largest value: with those of another
// field where it is not the first.
template <class F> INLINE void surround_row(
    int row, const F* field, int channels, int depth, int height, int width, int pitch,
    bool is_first, F* inner, int* occupied, F* tops) {
    int from = is_first ? width : occupied[2 * row], to = is_first ? 0 : occupied[2 * row + 1];
    F top = is_first ? F(0) : tops[row];
    for (int channel = 0; channel < channels; ++channel) {
        const F* in = field + ((long long)channel * depth * height + row) * width;
        const long long place = (channel * (depth + 2LL) + row / height) * (height + 2);
        F* out = inner + (place + row % height) * pitch;
        for (int c = 0; c < width; ++c) {
            const F value = in[c];
            out[c] = value;
            top = is_first && value > top ? value : top;
            from = value != F(0) && c < from ? c : from;
            to = value != F(0) ? c + 1 : to;
        }
    }
    occupied[2 * row] = from;
    occupied[2 * row + 1] = to;
    tops[row] = top;
}

// What steps to a row meet, and steps that begin there: light at the ends of a step is a cell away
// at most, along each axis.
template <class F> INLINE void reach_row(
    int row, const int* occupied, const F* tops, int depth, int height, int width, int margin,
    int* ranges, F* densest) {
    for (int cells = 1; cells <= 2; ++cells) {
        int from = width, to = 0;
        F top = F(0);
        for (int z = row / height - cells; z <= row / height + cells; ++z)
            for (int y = row % height - cells; y <= row % height + cells; ++y) {
                if (z < 0 || z >= depth || y < 0 || y >= height) continue;
                const int other = z * height + y, *one = occupied + 2 * other;
                top = tops[other] > top ? tops[other] : top;
                from = one[0] < from ? one[0] : from;
                to = one[1] > to ? one[1] : to;
            }
        const bool is_met = from < to;
        const int end = (to + cells + margin - 1) / margin * margin;
        int* range = ranges + 4 * row + 2 * (cells - 1);
        range[0] = is_met && from > cells ? (from - cells) / margin * margin : 0;
        range[1] = is_met ? end < width ? end : width : 0;
        if (cells == 1) densest[row] = top;
    }
}

} // namespace ddrecon
