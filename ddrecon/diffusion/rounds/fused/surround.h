#pragma once
#include "ddrecon/kernels/numbers.h"

namespace ddrecon {

// A row of a field, of all its channels, to where there are empty cells around it; of the row, how
// many cells there are from the first to the far end that are not empty, and from the near end to
// the last, and the largest value, with those of another field where it is not the first.
template <class F> INLINE void surround_row(
    int row, const F* field, int channels, int depth, int height, int width, int pitch,
    bool is_first, F* inner, F* rows) {
    const int count = depth * height;
    int from = is_first ? width : width - (int)rows[row],
        to = is_first ? 0 : (int)rows[count + row];
    F top = is_first ? F(0) : rows[2 * count + row];
    for (int channel = 0; channel < channels; ++channel) {
        const F* in = field + ((long long)channel * count + row) * width;
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
    rows[row] = F(width - from);
    rows[count + row] = F(to);
    rows[2 * count + row] = top;
}

} // namespace ddrecon
