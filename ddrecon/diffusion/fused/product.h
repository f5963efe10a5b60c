#pragma once
#include "ddrecon/diffusion/fused/mesh.h"

namespace ddrecon {

// A u of E7, `sign` times, and added to what is BEGUN. The `matrix` is the loss, then conductances
// along z, y and x: in each color, or in one that all share.
template <bool BEGUN, class F> INLINE void multiply(
    const Row& row, const Mesh<F>& mesh, F sign, const int* is_each, const F* const* matrix,
    const F* light, const F* begun, F* product) {
    const F *u = light + row.at, *before = begun + row.at, *faces[3];
    const F* loss = matrix[0] + (is_each[0] ? row.at : row.start);
    F* out = product + row.at;
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
        if constexpr (BEGUN)
            out[i] = before[i] + sign * sum;
        else
            out[i] = sign * sum;
    }
}

// Cotangents of the matrix (E9), of a row in all colors: what they share gets the sum.
template <class F> INLINE void find_matrix_bars(
    const Row& row, const Mesh<F>& mesh, int colors, const int* is_each, const F* adjoint,
    const F* light, F* const* bars) {
    const long long cells = row.items / colors * row.width;
    for (int c = 0; c < colors; ++c) {
        const F *a = adjoint + c * cells + row.start, *b = light + c * cells + row.start;
        const auto spread = [&](int k, F* out, int count, auto&& find) HERE {
            const bool adds = c > 0 && !is_each[k];
            INDEPENDENT
            for (int i = 0; i < count; ++i) out[i] = adds ? out[i] + find(i) : find(i);
        };
        spread(0, bars[0] + (is_each[0] ? c : 0) * cells + row.start, row.width, [&](int i) HERE {
            return -a[i] * b[i];
        });
        UNROLLED
        for (int k = 0; k < 3; ++k) {
            const long long to = mesh.step[k];
            F* faces = mesh.at_faces(bars[1 + k], k, is_each[1 + k] ? c : 0);
            const int count = mesh.inside(k, 1, row.width - 1) ? row.width
                              : k < 2                          ? 0
                                                               : row.width - 1;
            spread(1 + k, faces, count, [&](int i) HERE {
                return (a[i] - a[i + to]) * (b[i + to] - b[i]);
            });
        }
    }
}

} // namespace ddrecon
