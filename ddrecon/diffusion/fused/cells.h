#pragma once
#include "ddrecon/kernels/cells.h"
// Functions of a cell and of what is around it. Linear ones, with their tangents and cotangents: by
// how much a field rises from cell to cell (E2.9), and the sum of its second differences.

namespace ddrecon {

// A row along x, and the places of its cells along z, y and x, of so many.
struct Line3 {
    long long step[3];
    int count[3], first[3], width;
    INLINE Line3(const Row& row, int nz, int ny, int nx)
        : step{(long long)ny * nx, nx, 1}, count{nz, ny, nx}, width(row.width) {
        const long long number = row.start / nx;
        first[0] = (int)(number / ny), first[1] = (int)(number % ny), first[2] = row.start % nx;
    }
    // To a result along an axis is added what an `Around` weighs there, or its transpose.
    template <class Around, bool IS_BACK, int AXIS, class F>
    INLINE void add(const F* field, F* result) const {
        if (Around::ONLY >= 0 && Around::ONLY != AXIS) return;
        const int n = count[AXIS];
        const auto add_cell = [&](int i, bool inner) HERE {
            const int k = first[AXIS] + (AXIS == 2 ? i : 0);
            F sum = result[i];
            UNROLLED
            for (int side = -1; side < 2; ++side) {
                const bool inside = inner || (k + side >= 0 && k + side < n);
                const int weight =
                    IS_BACK ? Around::weight(k + side, n, -side) : Around::weight(k, n, side);
                sum +=
                    F(inside ? weight : 0) * F(0.125) * field[i + (inside ? side * step[AXIS] : 0)];
            }
            result[i] = sum;
        };
        const bool is_line = AXIS == 2 && width > 1;
        if (is_line) {
            add_cell(0, false), add_cell(width - 1, false);
            INDEPENDENT
            for (int i = 1; i < width - 1; ++i) add_cell(i, true);
        } else {
            INDEPENDENT
            for (int i = 0; i < (AXIS < 2 ? width : 1); ++i) add_cell(i, false);
        }
    }
};

// For cell k of n, eight times the weight of the cell on one `side` along an axis or the other, or
// its own. Half the difference of both neighbors; at the faces of the box, that to the one.
struct Rises {
    static constexpr int OUTS = 3, ONLY = -1;
    INLINE static int weight(int k, int n, int side) {
        const int below = k > 0, above = k < n - 1;
        const int sign = side < 0 ? -below : side > 0 ? above : below - above;
        return below + above == 2 ? 4 * sign : 8 * sign;
    }
};
// The second difference; 0 at the ends of an axis.
struct Bends {
    static constexpr int OUTS = 1, ONLY = -1;
    INLINE static int weight(int k, int n, int side) {
        return k > 0 && k < n - 1 ? (side ? 8 : -16) : 0;
    }
};
// The mean along an axis of what is linear between centers, and even beyond the outermost.
template <int AXIS> struct Means {
    static constexpr int OUTS = 1, ONLY = AXIS;
    INLINE static int weight(int k, int n, int side) {
        return side ? 1 : 8 - (k > 0) - (k < n - 1);
    }
};

template <class Around, class N, class F> INLINE void find_values(
    const Row& row, const Line3& line, const int* channels, const F* const* fields,
    const F* const* d_fields, const F*, const F*, F* const* results) {
    const F* const* inputs = IS_DUAL<N> ? d_fields : fields;
    const F* const field = inputs[0] + (row.color % channels[0] * row.size + row.start);
    F* result[3];
    for (int axis = 0; axis < 3; ++axis) {
        result[axis] = results[0] + (axis % Around::OUTS * row.items * row.width + row.at);
        for (int i = 0; i < row.width; ++i) result[axis][i] = F(0);
    }
    line.add<Around, false, 0>(field, result[0]);
    line.add<Around, false, 1>(field, result[1]);
    line.add<Around, false, 2>(field, result[2]);
}
template <class Around, class F> INLINE void find_cotangents(
    const Row& row, const Line3& line, const int*, const F* const*, const F*, const F* const* bars,
    F* const* results, F* sums) {
    F* const result = results[0] + row.at;
    const F* bar[3];
    for (int axis = 0; axis < 3; ++axis)
        bar[axis] = bars[0] + (axis % Around::OUTS * row.items * row.width + row.at);
    for (int i = 0; i < row.width; ++i) result[i] = F(0);
    line.add<Around, true, 0>(bar[0], result);
    line.add<Around, true, 1>(bar[1], result);
    line.add<Around, true, 2>(bar[2], result);
    sums[row.item] = F(0);
}

// D = 1 / (3 kappa_tr + 4 / distance), as `diffusion/closures.py` has it. Its fields are 1 /
// distance and those of so many TERMS of kappa_tr, its numbers their scales.
template <int TERMS> struct Geometric {
    static constexpr int INS = 1 + TERMS, NUMBERS = TERMS, OUTS = 1;

    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        const N spreading = 4 * in[0];
        N extinction = number[0] * in[1];
        UNROLLED
        for (int k = 1; k < TERMS; ++k) extinction += number[k] * in[1 + k];
        const N ratio = 3 * extinction / spreading;
        const N continued = 1 - ratio + ratio * ratio;
        out[0] = pick(value_of(ratio) < 0, continued, 1 / (1 + ratio)) / spreading;
    }
};

// Light at a center, >= 0, of its mean, its second differences and the extinction's field (E2.12);
// the number makes that optical depths of what is thin.
struct Sharp {
    static constexpr int INS = 3, NUMBERS = 1, OUTS = 1;

    template <class N> INLINE static void find(const N* in, const N* number, N* out) {
        // to the fourth power, which must not overflow
        const N full = number[0] * in[2], depth = full / (1 + full / 1000000);
        const N square = depth * depth;
        const N light = in[0] - in[1] / (8 * (1 + square * square));
        out[0] = pick(value_of(light) < 0, 0 * light, light);
    }
};

} // namespace ddrecon
