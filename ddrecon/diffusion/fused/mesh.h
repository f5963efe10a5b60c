#pragma once
#include "ddrecon/kernels/cells.h"

namespace ddrecon {

// A row of cells in a grid, from its number x on. Neighbors lie below and above (`side` 0 and 1)
// along z, y and x (`axis` 0 to 2): the last cell is a neighbor of the first along axes of which
// `periodic` has the bit. A cell that is its own neighbor `conducts` nothing. Faces between cells
// lie in arrays as large as the grid, at the cell below.
template <class F> struct Mesh {
    typedef F Number;
    int nx, x;
    bool wraps, has_before, has_after, has[2][2], conducts[3];
    long long step[2][2];
    F h[3];

    INLINE Mesh(const Row& row, int nz, int ny, int nx, int periodic, F hz, F hy, F hx)
        : nx(nx),
          x(row.start % nx),
          wraps(periodic >> 2 & 1),
          has_before(row.start > 0),
          has_after(row.start + row.width < row.size),
          conducts{nz > 1, ny > 1, nx > 1},
          h{hz, hy, hx} {
        const long long number = row.start / nx;
        const int n[2] = {nz, ny}, at[2] = {(int)(number / ny), (int)(number % ny)};
        const long long steps[2] = {(long long)ny * nx, nx};
        UNROLLED
        for (int axis = 0; axis < 2; ++axis) {
            const bool is_first = at[axis] == 0, is_last = at[axis] == n[axis] - 1;
            const bool around = periodic >> axis & 1;
            const long long step_around = around ? (n[axis] - 1) * steps[axis] : 0;
            has[axis][0] = around || !is_first;
            has[axis][1] = around || !is_last;
            step[axis][0] = is_first ? step_around : -steps[axis];
            step[axis][1] = is_last ? -step_around : steps[axis];
        }
    }
    INLINE bool inside(int axis, int side, int i) const {
        return axis < 2 ? has[axis][side] : wraps || (side ? x + i < nx - 1 : x + i > 0);
    }
    // A number of the cell beyond a face; of this one where there is none.
    template <class In> INLINE auto beyond(const In& in, int axis, int side, int i) const {
        if (axis < 2) return in[i + step[axis][side]];
        const int around = wraps ? nx - 1 : 0;
        return side ? in[x + i < nx - 1 ? i + 1 : i - around] : in[x + i > 0 ? i - 1 : i + around];
    }
    // A face's number, of the row's; 0 where there is none.
    template <class In> INLINE F at_face(const In& in, int axis, int side, int i) const {
        return !inside(axis, side, i) ? F(0) : side ? in[i] : beyond(in, axis, 0, i);
    }
    // Does `act` with this, or with an `InnerMesh`.
    template <class Act> INLINE void visit(const Act& act) const;
};

// Of a row before and behind which lie others: numbers there may be read for nothing, which takes
// less time than to look where the row ends.
template <class F> struct InnerMesh : Mesh<F> {
    INLINE InnerMesh(const Mesh<F>& mesh) : Mesh<F>(mesh) {}
    template <class In> INLINE auto beyond(const In& in, int axis, int side, int i) const {
        return axis < 2 ? Mesh<F>::beyond(in, axis, side, i) : in[side ? i + 1 : i - 1];
    }
    template <class In> INLINE F at_face(const In& in, int axis, int side, int i) const {
        const F face = side ? in[i] : beyond(in, axis, 0, i);
        return Mesh<F>::inside(axis, side, i) ? face : F(0);
    }
};
template <class F> template <class Act> INLINE void Mesh<F>::visit(const Act& act) const {
    if (has_before && has_after && !wraps)
        act(InnerMesh<F>(*this));
    else
        act(*this);
}

} // namespace ddrecon
