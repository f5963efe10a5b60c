#pragma once
#include "ddrecon/diffusion/fused/mesh.h"

namespace ddrecon {

// What is BEGUN less A u of E2.7. The `matrix` is the loss, then conductances
// along z, y and x: in each color, or in one that all share.
template <class F> INLINE void subtract_product(
    const Row& row, const Mesh<F>& mesh, const int* is_each, const F* const* matrix, const F* light,
    const F* begun, F* found) {
    const F *u = light + row.at, *before = begun + row.at, *faces[3];
    const F* loss = matrix[0] + (is_each[0] ? row.at : row.start);
    F* out = found + row.at;
    UNROLLED
    for (int a = 0; a < 3; ++a)
        faces[a] = mesh.at_faces(matrix[1 + a], a, is_each[1 + a] ? row.color : 0);
    INDEPENDENT
    for (int i = 0; i < row.width; ++i) {
        F sum = loss[i] * u[i];
        UNROLLED
        for (int k = 0; k < 6; ++k)
            sum += mesh.at_face(faces[k / 2], k / 2, k % 2, i) *
                   (u[i] - mesh.beyond(u, k / 2, k % 2, i));
        out[i] = before[i] - sum;
    }
}

// Of what solves the operator's system (E3.2): loss_bar = -lambda u, and c_bar = -(G lambda)(G u).
template <class F> INLINE void find_cotangents(
    const Row& row, const Mesh<F>& mesh, const F* adjoint, const F* light, F* const* bars) {
    const F *l = adjoint + row.at, *u = light + row.at;
    F *loss = bars[0] + row.at, *faces[3];
    UNROLLED
    for (int a = 0; a < 3; ++a) faces[a] = mesh.at_faces(bars[1 + a], a, row.color);
    INDEPENDENT
    for (int i = 0; i < row.width; ++i) {
        loss[i] = -l[i] * u[i];
        UNROLLED
        for (int a = 0; a < 3; ++a) {
            const F rise = mesh.beyond(u, a, 1, i) - u[i];
            if (mesh.inside(a, 1, i)) faces[a][i] = (l[i] - mesh.beyond(l, a, 1, i)) * rise;
        }
    }
}

} // namespace ddrecon
