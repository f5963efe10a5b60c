#pragma once
#include "ddrecon/kernels/cells.h"
// Linear functions of a field around a cell (E2.9), their tangents and cotangents: by how much it
// rises from cell to cell, and its mean in the cell.

namespace ddrecon {

// A row along x, and the places of its cells along z, y and x, of so many.
struct Line3 {
    long long step[3];
    int count[3], first[3];
    INLINE Line3(const Row& row, int nz, int ny, int nx)
        : step{(long long)ny * nx, nx, 1}, count{nz, ny, nx} {
        const long long number = row.start / nx;
        first[0] = (int)(number / ny), first[1] = (int)(number % ny), first[2] = row.start % nx;
    }
    INLINE int place(int a, int i) const { return a < 2 ? first[a] : first[a] + i; }
    // How far the next cell lies, to one `side` or the other; none beyond the faces of the box.
    INLINE long long next(int a, int side, int i) const {
        const int to = place(a, i) + side;
        return to < 0 || to >= count[a] ? 0 : side * step[a];
    }
    // What a difference of both neighbors counts at a cell, or at one beside it.
    INLINE double half(int a, int beside, int i) const {
        const int at = place(a, i) + beside;
        return at <= 0 || at >= count[a] - 1 ? 1.0 : 0.5;
    }
};

// Half the difference of both neighbors along an axis; at the faces of the box, that to the one.
struct Rises {
    template <class F>
    INLINE static void find(const Row& row, const Line3& line, const F* q, F* const* out) {
        for (int a = 0; a < 3; ++a) {
            F* const found = out[0] + (a * row.items * row.width + row.at);
            INDEPENDENT
            for (int i = 0; i < row.width; ++i)
                found[i] = F(line.half(a, 0, i)) *
                           (q[i + line.next(a, 1, i)] - q[i + line.next(a, -1, i)]);
        }
    }
    template <class F> INLINE static void find_back(
        const Row& row, const Line3& line, const F* const* bars, F* found) {
        for (int i = 0; i < row.width; ++i) found[i] = F(0);
        for (int a = 0; a < 3; ++a) {
            const F* const bar = bars[0] + (a * row.items * row.width + row.at);
            INDEPENDENT
            for (int i = 0; i < row.width; ++i) {
                const long long low = line.next(a, -1, i), high = line.next(a, 1, i);
                const F below = F(line.half(a, low ? -1 : 0, i)) * bar[i + low];
                const F above = F(line.half(a, high ? 1 : 0, i)) * bar[i + high];
                found[i] += (low ? below : -below) + (high ? -above : above);
            }
        }
    }
};

// The mean in a cell of what is linear between centers and stays beyond the outermost: of both
// neighbors along each axis an eighth. That is symmetric.
struct Means {
    template <class F>
    INLINE static void find(const Row& row, const Line3& line, const F* f, F* const* out) {
        INDEPENDENT
        for (int i = 0; i < row.width; ++i) {
            F sum = 0;
            UNROLLED
            for (int k = 0; k < 9; ++k) {
                const int z = k / 3 - 1, y = k % 3 - 1;
                const F* row_of = f + (z ? line.next(0, z, 0) : 0) + (y ? line.next(1, y, 0) : 0);
                sum += F((z ? 1 : 6) * (y ? 1 : 6) / 512.0) *
                       (row_of[i + line.next(2, -1, i)] + 6 * row_of[i] +
                        row_of[i + line.next(2, 1, i)]);
            }
            out[0][row.at + i] = sum;
        }
    }
    template <class F> INLINE static void find_back(
        const Row& row, const Line3& line, const F* const* bars, F* found) {
        F* const out[1] = {found - row.at};
        find(row, line, bars[0] + row.at, out);
    }
};

// The sum of the second differences along all axes, without those of cells at the ends of an axis.
struct Bends {
    template <class F>
    INLINE static void find(const Row& row, const Line3& line, const F* f, F* const* out) {
        for (int i = 0; i < row.width; ++i) {
            F sum = 0;
            UNROLLED
            for (int a = 0; a < 3; ++a) {
                const long long low = line.next(a, -1, i), high = line.next(a, 1, i);
                if (low && high) sum += f[i + low] - 2 * f[i] + f[i + high];
            }
            out[0][row.at + i] = sum;
        }
    }
    template <class F> INLINE static void find_back(
        const Row& row, const Line3& line, const F* const* bars, F* found) {
        const F* const bar = bars[0] + row.at;
        for (int i = 0; i < row.width; ++i) {
            F sum = 0;
            UNROLLED
            for (int a = 0; a < 3; ++a) {
                const long long low = line.next(a, -1, i), high = line.next(a, 1, i);
                // Of the neighbors those count that are not at an end themselves.
                if (low && line.place(a, i) > 1) sum += bar[i + low];
                if (low && high) sum -= 2 * bar[i];
                if (high && line.place(a, i) < line.count[a] - 2) sum += bar[i + high];
            }
            found[i] = sum;
        }
    }
};

template <class Cell, class N, class F> INLINE void find_values(
    const Row& row, const Line3& line, const int* channels, const F* const* fields,
    const F* const* d_fields, const F*, const F*, F* const* made) {
    const F* const* all = IS_DUAL<N> ? d_fields : fields;
    Cell::find(row, line, all[0] + (row.color % channels[0] * row.size + row.start), made);
}
template <class Cell, class F> INLINE void find_cotangents(
    const Row& row, const Line3& line, const int*, const F* const*, const F*, const F* const* bars,
    F* const* made, F* sums) {
    Cell::find_back(row, line, bars, made[0] + row.at);
    sums[row.item] = F(0);
}

} // namespace ddrecon
