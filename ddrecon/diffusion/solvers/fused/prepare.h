#pragma once
#include "ddrecon/diffusion/fused/mesh.h"
// A hierarchy is made, a row at a time: scaled matrices and coarser ones. The formulas are those of
// `solvers/scaled.py` and `hierarchy.py`. A matrix has conductances along z, y and
// x, and the loss; faces lie at the cell below them, and those on the box are zero.

namespace ddrecon {

// What a launch does. SCALE_CELLS makes S and S times what a cell exchanges with its neighbors,
// SCALE_FACES the conductances of S A S; WEIGH and COARSEN the two weights of faces between pairs
// of cells along an axis, and the coarser matrix.
enum Step { SCALE_CELLS, SCALE_FACES, WEIGH, COARSEN };
enum { LOSS = 3, SCALE = 3, TAKEN = 4, BELOW = 4, ABOVE = 5 };

template <class F> INLINE void scale_cells(
    const Row& row, const Mesh<F>& mesh, const F* const* matrix, F* const* made) {
    const F* c[4];
    F* out[5];
    row.in_all<4>(matrix, c);
    row.in_all<5>(made, out);
    INDEPENDENT
    for (int i = 0; i < row.width; ++i) {
        F exchanged = 0;
        UNROLLED
        for (int k = 0; k < 6; ++k) exchanged += mesh.at_face(c[k / 2], k / 2, k % 2, i);
        const F scale = 1 / root(exchanged + c[LOSS][i]);
        out[SCALE][i] = scale;
        out[TAKEN][i] = scale * exchanged;
    }
}
template <class F> INLINE void scale_faces(
    const Row& row, const Mesh<F>& mesh, const F* const* matrix, F* const* made) {
    const F* const scale = made[SCALE] + row.at;
    INDEPENDENT
    for (int i = 0; i < row.width; ++i) {
        UNROLLED
        for (int a = 0; a < 3; ++a)
            made[a][row.at + i] = matrix[a][row.at + i] * scale[i] * mesh.beyond(scale, a, 1, i);
    }
}

// Pairs of cells of a finer grid of `n` cells, which along AXIS become a row of the grid of `mesh`.
template <int AXIS, class F> struct Pairs {
    static constexpr int STEP = AXIS == 2 ? 2 : 1;
    const Mesh<F>& mesh;
    int width, behind;
    long long step[3];
    const F* fine[4];
    F* made[6];

    INLINE Pairs(
        const Row& row, const Mesh<F>& mesh, int ny, const int* n, const F* const* matrix,
        F* const* made)
        : mesh(mesh), width(row.width), step{(long long)n[1] * n[2], n[2], 1} {
        const long long number = row.start / width, z = number / ny, y = number % ny;
        const long long first = (AXIS == 0 ? 2 * z : z) * step[0] + (AXIS == 1 ? 2 * y : y) * n[2];
        behind = n[AXIS] - 1 - (int)(AXIS == 0 ? 2 * z : AXIS == 1 ? 2 * y : 0);
        UNROLLED
        for (int b = 0; b < 4; ++b) fine[b] = matrix[b] + row.color * n[0] * step[0] + first;
        row.in_all<6>(made, this->made);
    }
    // Whether so many cells lie behind the first one of a pair; and how far the last of them is.
    INLINE bool has(int i, int k) const { return (AXIS == 2 ? behind - 2 * i : behind) >= k; }
    INLINE long long to(int k) const { return AXIS == 2 || behind >= k ? k * step[AXIS] : 0; }
    // Resistors from a pair's cell to the next pair's: where the face between stands, and 1 /
    // resistance.
    INLINE void weigh() const {
        const F* const along = fine[AXIS];
        const long long face = to(1), next = to(2);
        INDEPENDENT
        for (int i = 0; i < width; ++i) {
            const int at = i * STEP;
            const F low = F(0.5) / along[at], high = has(i, 3) ? F(0.5) / along[at + next] : F(0);
            const F inverse = 1 / (low + 1 / along[at + face] + high);
            const bool is_between = has(i, 2);
            made[BELOW][i] = is_between ? low * inverse : F(0);
            made[ABOVE][i] = is_between ? high * inverse : F(0);
            made[AXIS][i] = is_between ? inverse : F(0);
        }
    }
    // Across the axis in parallel, and losses: sums of pairs. Along it the energy c (w - w')^2 of
    // what runs across, half to each of two neighbors (Galerkin).
    INLINE void coarsen() const {
        const F *const below = made[BELOW], *const above = made[ABOVE];
        const long long second = to(1), third = to(2);
        INDEPENDENT
        for (int i = 0; i < width; ++i) {
            const int at = i * STEP;
            const bool is_pair = has(i, 1), is_between = has(i, 2);
            F energy = 0;
            UNROLLED
            for (int b = 0; b < 4; ++b) {
                if (b == AXIS) continue;
                made[b][i] = fine[b][at] + (is_pair ? fine[b][at + second] : F(0));
                UNROLLED
                for (int side = 0; side < (b < 3 ? 2 : 0); ++side) {
                    // Faces towards the neighbor: those above the lower of both. Along x one may
                    // lie before the first cell: a zero, like w.
                    const bool is_lower = !side && (b == 2 || mesh.has[b][0]);
                    const F* const c = fine[b] + at - (is_lower ? step[b] : 0);
                    const F w = below[i] - mesh.beyond(below, b, side, i);
                    const F v = above[i] - mesh.beyond(above, b, side, i);
                    energy += c[second] * w * w + c[third] * v * v;
                }
            }
            made[AXIS][i] += is_between ? F(0.5) * energy : F(0);
        }
    }
};

template <int AXIS, class F> INLINE void halve(const Pairs<AXIS, F>& pairs, int step) {
    step == WEIGH ? pairs.weigh() : pairs.coarsen();
}
template <class F> INLINE void prepare(
    const Row& row, const Mesh<F>& mesh, int step, int axis, int ny, const int* finer,
    const F* const* matrix, F* const* made) {
    if (step == SCALE_CELLS) scale_cells(row, mesh, matrix, made);
    if (step == SCALE_FACES) scale_faces(row, mesh, matrix, made);
    if (step < WEIGH) return;
    if (axis == 0) halve(Pairs<0, F>(row, mesh, ny, finer, matrix, made), step);
    if (axis == 1) halve(Pairs<1, F>(row, mesh, ny, finer, matrix, made), step);
    if (axis == 2) halve(Pairs<2, F>(row, mesh, ny, finer, matrix, made), step);
}

} // namespace ddrecon
