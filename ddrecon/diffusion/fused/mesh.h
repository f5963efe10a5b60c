#pragma once
#include "ddrecon/kernels/cells.h"

namespace ddrecon {

// A row of cells in a grid, from its number x on. Neighbors lie below and above (`side` 0 and 1)
// along z, y and x (`axis` 0 to 2). Faces between cells lie in arrays, so many `faces` of a color;
// that above the row's first cell is number `face`.
template <class F> struct Mesh {
    typedef F Number;
    int nx, x;
    bool has[2][2];
    long long step[3], face[3], faces[3];
    F h[3];

    INLINE Mesh(const Row& row, int nz, int ny, int nx, F hz, F hy, F hx)
        : nx(nx), x(row.start % nx), step{(long long)ny * nx, nx, 1}, h{hz, hy, hx} {
        const long long number = row.start / nx, z = number / ny, y = number % ny;
        has[0][0] = z > 0, has[0][1] = z < nz - 1, has[1][0] = y > 0, has[1][1] = y < ny - 1;
        face[0] = row.start, face[1] = row.start - z * nx, face[2] = row.start - number;
        faces[0] = (nz - 1) * step[0], faces[1] = nz * (step[0] - nx);
        faces[2] = nz * (step[0] - ny);
    }
    INLINE bool inside(int axis, int side, int i) const {
        return axis < 2 ? has[axis][side] : side ? x + i < nx - 1 : x + i > 0;
    }
    // A number of the cell beyond a face; of this one where there is none.
    template <class In> INLINE auto beyond(const In& in, int axis, int side, int i) const {
        if (axis < 2) return in[i + (has[axis][side] ? side ? step[axis] : -step[axis] : 0)];
        return inside(axis, side, i) ? in[side ? i + 1 : i - 1] : in[i];
    }
    template <class P> INLINE P* at_faces(P* all, int axis, int color) const {
        return all + color * faces[axis] + face[axis];
    }
    // A face's number, of the row's; 0 where there is none.
    INLINE F at_face(const F* row, int axis, int side, int i) const {
        return inside(axis, side, i) ? row[side ? i : i - step[axis]] : F(0);
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
};
template <class F> template <class Act> INLINE void Mesh<F>::visit(const Act& act) const {
    if ((has[0][0] || has[1][0]) && (has[0][1] || has[1][1]))
        act(InnerMesh<F>(*this));
    else
        act(*this);
}

} // namespace ddrecon
