#pragma once
#include "ddrecon/diffusion/rounds/fused/given.h"
// Fields of coefficients with empty cells around them, and where their rows are not empty.

namespace ddrecon {

// A row of all fields, with those around the box.
template <class F> INLINE void surround_row(int item, const Surrounded<F>& of) {
    const int width = of.width, margin = of.margin;
    const int z = item / (of.height + 2) - 1, y = item % (of.height + 2) - 1;
    const bool is_inside = z >= 0 && z < of.depth && y >= 0 && y < of.height;
    const long long rows = (of.depth + 2LL) * (of.height + 2);
    int from = width, to = 0;
    F top = F(0), *begin = of.larger;
    for (int field = 0; field < of.fields; ++field) {
        const F* cells = field ? of.scattering : of.extinction;
        const int channels = field ? of.scattering_channels : of.extinction_channels;
        for (int c = 0; item == 0 && c < margin; ++c) begin[c] = F(0);
        for (int channel = 0; channel < channels; ++channel) {
            F* out = begin + margin + (channel * rows + item) * of.pitch;
            const long long row = ((long long)channel * of.depth + z) * of.height + y;
            for (int c = 0; c < of.pitch; ++c) out[c] = F(0);
            for (int c = 0; is_inside && c < width; ++c) {
                const F value = cells[row * width + c];
                out[c] = value;
                top = field == 0 && value > top ? value : top;
                from = value != F(0) && c < from ? c : from;
                to = value != F(0) ? c + 1 : to;
            }
        }
        begin += margin + channels * rows * of.pitch;
    }
    of.tops[item] = top;
    of.occupied[2 * item] = from;
    of.occupied[2 * item + 1] = to;
}

// Light at the ends of a step is a cell away at most, along each axis.
template <class F> INLINE void reach_row(int item, const Surrounded<F>& of) {
    const int z = item / of.height, y = item % of.height, width = of.width, margin = of.margin;
    for (int cells = 1; cells <= 2; ++cells) {
        int from = width, to = 0;
        F top = F(0);
        for (int k = z - cells; k <= z + cells; ++k)
            for (int r = y - cells; r <= y + cells; ++r) {
                if (k < 0 || k >= of.depth || r < 0 || r >= of.height) continue;
                const int row = (k + 1) * (of.height + 2) + r + 1, *one = of.occupied + 2 * row;
                top = of.tops[row] > top ? of.tops[row] : top;
                from = one[0] < from ? one[0] : from;
                to = one[1] > to ? one[1] : to;
            }
        const bool is_met = from < to;
        from = from > cells ? from - cells : 0;
        to = (to + cells + margin - 1) / margin * margin;
        int* range = of.ranges + 4 * item + 2 * (cells - 1);
        if (cells == 1) of.densest[item] = top;
        range[0] = is_met ? from / margin * margin : 0;
        range[1] = is_met ? to < width ? to : width : 0;
    }
}

} // namespace ddrecon
