#pragma once
#include "ddrecon/diffusion/fused/mesh.h"
#include "ddrecon/diffusion/solvers/fused/levels.h"
// A hierarchy is made, a row at a time: scaled matrices and coarser ones. The formulas are those of
// `solvers/scaled.py` and `hierarchy.py`. A matrix has conductances along z, y and
// x, and the loss; faces lie at the cell below them, and those on the box are zero.

namespace ddrecon {

// What is done at a stage. SCALE_CELLS makes S and S times what a cell exchanges with its
// neighbors, SCALE_FACES the conductances of S A S, if it is a level; WEIGH and COARSEN make the
// two weights of faces between pairs of cells along its axis, and the next stage's matrix.
enum Step { SCALE_CELLS, SCALE_FACES, WEIGH, COARSEN, STEPS };

// COUNT arrays of a stage, from a column on, from the row on.
template <int COUNT, class F>
INLINE void find_rows(const Grids<F>& grids, int stage, int column, const Row& row, F** found) {
    UNROLLED
    for (int k = 0; k < COUNT; ++k) found[k] = grids.array(stage, column + k, row.at);
}

template <class F>
INLINE void scale_cells(const Grids<F>& grids, int stage, const Row& row, const Mesh<F>& mesh) {
    F *c[4], *out[2];
    find_rows<4>(grids, stage, CZ, row, c);
    find_rows<2>(grids, stage, SCALE, row, out);
    INDEPENDENT
    for (int i = 0; i < row.width; ++i) {
        F exchanged = 0;
        UNROLLED
        for (int k = 0; k < 6; ++k) exchanged += mesh.at_face(c[k / 2], k / 2, k % 2, i);
        const F scale = 1 / root(exchanged + c[3][i]);
        out[0][i] = scale;
        out[1][i] = scale * exchanged;
    }
}
// Returns in `sums` those of the row's conductances along each axis.
template <class F> INLINE void scale_faces(
    const Grids<F>& grids, int stage, const Row& row, const Mesh<F>& mesh, F* sums) {
    REORDERED
    F *c[4], *out[3], z = 0, y = 0, x = 0;
    find_rows<4>(grids, stage, CZ, row, c);
    find_rows<3>(grids, stage, SZ, row, out);
    const F* const scale = grids.array(stage, SCALE, row.at);
    SUMMING
    for (int i = 0; i < row.width; ++i) {
        UNROLLED
        for (int a = 0; a < 3; ++a) out[a][i] = c[a][i] * scale[i] * mesh.beyond(scale, a, 1, i);
        z += out[0][i], y += out[1][i], x += out[2][i];
    }
    sums[0] = z, sums[1] = y, sums[2] = x;
}

// Pairs of cells of a stage, which along AXIS become a row of the grid of `mesh`, the next one.
template <int AXIS, class F> struct Pairs {
    static constexpr int STEP = AXIS == 2 ? 2 : 1;
    const Mesh<F>& mesh;
    int width, behind;
    long long step[3];
    const F* fine[4];
    F *made[4], *weights[2];

    INLINE Pairs(const Grids<F>& grids, int stage, const Row& row, const Mesh<F>& mesh)
        : mesh(mesh), width(row.width) {
        int n[3];
        UNROLLED
        for (int a = 0; a < 3; ++a) n[a] = (int)grids.at(stage, NZ + a);
        step[0] = (long long)n[1] * n[2], step[1] = n[2], step[2] = 1;
        const long long number = row.start / width, ny = grids.at(stage + 1, NY);
        const long long z = number / ny, y = number % ny;
        const long long first = (AXIS == 0 ? 2 * z : z) * step[0] + (AXIS == 1 ? 2 * y : y) * n[2];
        behind = n[AXIS] - 1 - (int)(AXIS == 0 ? 2 * z : AXIS == 1 ? 2 * y : 0);
        UNROLLED
        for (int b = 0; b < 4; ++b)
            fine[b] = grids.array(stage, CZ + b, row.color * n[0] * step[0] + first);
        find_rows<4>(grids, stage + 1, CZ, row, made);
        find_rows<2>(grids, stage, BELOW, row, weights);
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
            weights[0][i] = is_between ? low * inverse : F(0);
            weights[1][i] = is_between ? high * inverse : F(0);
            made[AXIS][i] = is_between ? inverse : F(0);
        }
    }
    // Across the axis in parallel, and losses: sums of pairs. Along it the energy c (w - w')^2 of
    // what runs across, half to each of two neighbors (Galerkin).
    INLINE void coarsen() const {
        const F *const below = weights[0], *const above = weights[1];
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
template <int AXIS, class F>
INLINE void halve(const Grids<F>& grids, int stage, const Row& row, const Mesh<F>& mesh, int step) {
    const Pairs<AXIS, F> pairs(grids, stage, row, mesh);
    step == WEIGH ? pairs.weigh() : pairs.coarsen();
}

// Steps `first` to before `last`, where stage s begins with number s STEPS; of each one of so many
// `parts`. `sums` [3] are those of the scaled conductances of the last level.
template <class F> INLINE void prepare(
    const Grids<F>& grids, int colors, int first, int last, int part, int parts, double* sums) {
    for (int k = first; k < last; ++k) {
        const int stage = k / STEPS, step = k % STEPS, made = stage + (step >= WEIGH);
        if (step < WEIGH && !grids.at(stage, SCALE)) continue;
        const int ny = (int)grids.at(made, NY), nx = (int)grids.at(made, NX);
        const int nz = (int)grids.at(made, NZ), axis = (int)grids.at(stage, AXIS);
        const long long rows = (long long)colors * nz * ny;
        if (step == SCALE_FACES) sums[0] = sums[1] = sums[2] = 0;
        for (long long item = rows * part / parts; item < rows * (part + 1) / parts; ++item) {
            const Row row((int)item, nx, nz * ny, colors);
            const Mesh<F> mesh(row, nz, ny, nx, F(1), F(1), F(1));
            if (step == SCALE_CELLS) scale_cells(grids, stage, row, mesh);
            if (step == SCALE_FACES) {
                F own[3];
                scale_faces(grids, stage, row, mesh, own);
                for (int a = 0; a < 3; ++a) sums[a] += (double)own[a];
            }
            if (step < WEIGH) continue;
            if (axis == 0) halve<0>(grids, stage, row, mesh, step);
            if (axis == 1) halve<1>(grids, stage, row, mesh, step);
            if (axis == 2) halve<2>(grids, stage, row, mesh, step);
        }
    }
}

} // namespace ddrecon
