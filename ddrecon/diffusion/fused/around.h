#pragma once
#include "ddrecon/kernels/cells.h"
// Linear functions of a field around a cell (E2.9), their tangents and cotangents: by how much it
// rises from cell to cell, and its mean in the cell.

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
    INLINE int place(int a, int i) const { return a < 2 ? first[a] : first[a] + i; }
    // How far the next cell lies, to one `side` or the other; none beyond the faces of the box.
    INLINE long long next(int a, int side, int i) const {
        const int to = place(a, i) + side;
        return to < 0 || to >= count[a] ? 0 : side * step[a];
    }
    // To cells `from` one `to` another along an axis is added `weight` times what is `side` of
    // them.
    template <class F>
    INLINE void add(int a, int from, int to, int side, F weight, const F* q, F* found) const {
        const int own = first[a], size = a < 2 ? 1 : width;
        const int begin = from > own ? from - own : 0, end = to < own + size ? to - own : size;
        if (begin >= end) return;
        const F* const beside = q + side * step[a];
        const int last = a < 2 ? width : end;
        INDEPENDENT
        for (int i = begin; i < last; ++i) found[i] += weight * beside[i];
    }
    // What an `Around` finds along an axis is added; its transpose has the same weights.
    template <class Around, bool IS_BACK, class F>
    INLINE void add_all(int a, const F* q, F* found) const {
        Around::each(count[a], [&](int from, int to, int side, double weight) HERE {
            const int shift = IS_BACK ? side : 0;
            add(a, from + shift, to + shift, IS_BACK ? -side : side, F(weight), q, found);
        });
    }
    template <class F> INLINE void clear(F* found) const {
        for (int i = 0; i < width; ++i) found[i] = F(0);
    }
};

// Half the difference of both neighbors along an axis; at the faces of the box, that to the one.
struct Rises {
    template <class Add> INLINE static void each(int n, Add add) {
        add(1, n - 1, -1, -0.5), add(1, n - 1, 1, 0.5);
        if (n > 1) add(0, 1, 0, -1.0), add(0, 1, 1, 1.0);
        if (n > 1) add(n - 1, n, -1, -1.0), add(n - 1, n, 0, 1.0);
    }
    template <class F>
    INLINE static void find(const Row& row, const Line3& line, const F* q, F* const* out) {
        for (int a = 0; a < 3; ++a) {
            F* const found = out[0] + (a * row.items * row.width + row.at);
            line.clear(found);
            line.add_all<Rises, false>(a, q, found);
        }
    }
    template <class F> INLINE static void find_back(
        const Row& row, const Line3& line, const F* const* bars, F* found) {
        line.clear(found);
        for (int a = 0; a < 3; ++a) {
            const F* const bar = bars[0] + (a * row.items * row.width + row.at);
            line.add_all<Rises, true>(a, bar, found);
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
    template <class Add> INLINE static void each(int n, Add add) {
        add(1, n - 1, -1, 1.0), add(1, n - 1, 0, -2.0), add(1, n - 1, 1, 1.0);
    }
    template <class F>
    INLINE static void find(const Row& row, const Line3& line, const F* f, F* const* out) {
        line.clear(out[0] + row.at);
        for (int a = 0; a < 3; ++a) line.add_all<Bends, false>(a, f, out[0] + row.at);
    }
    template <class F> INLINE static void find_back(
        const Row& row, const Line3& line, const F* const* bars, F* found) {
        line.clear(found);
        for (int a = 0; a < 3; ++a) line.add_all<Bends, true>(a, bars[0] + row.at, found);
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
