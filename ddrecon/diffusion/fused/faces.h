#pragma once
#include "ddrecon/kernels/cells.h"
// What flows through the faces of cells (E2.5 to E2.7 of docs/theory.md). A cell goes through all
// six of its faces: for what it gains, and in the other direction for what its numbers count.

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

// What a face conducts: the harmonic mean of D here and there (E2.7), and on the box
// 1 / (2 + h / (2 D)) (E2.6). Times 1 / h^2, or 1 / h on the box, it is what the matrix has.
template <class N, class F> INLINE N conduct(const N& here, const N& there, F h, bool inside) {
    const N divisor = pick(inside, N(here + there), N(4 * here + h));
    return 2 * here * (pick(inside, there, N(F(1))) / divisor);
}

// Which moment of degree 1 is along z, y and x; and how many times that a flux is (`moments.py`).
constexpr int MOMENT[3] = {1, 0, 2};
constexpr double ROOT = 1.7320508075688772;

enum { GAIN, FLUX, SYSTEM };
// What cells gain from Q1, -div(D kappa_s Q1), or L1 (E2.5), or all of E2.7. Its fields are D and
// kappa_s but for its scale; then, unless it is a gain, L0 or Q0; of a system kappa_a but for its
// scale; the moments of Q1, if it HAS_FLUX; and so many ADDED, to which the result is added. Its
// numbers: the scale of kappa_s, the radiance outside, the scale of kappa_a.
template <int WHAT, int HAS_FLUX, int ADDED> struct Flow {
    static constexpr bool HAS_MEAN = WHAT != GAIN, IS_SYSTEM = WHAT == SYSTEM;
    enum { D, SCATTERING, MEAN, ABSORBING, Q = 2 + HAS_MEAN + IS_SYSTEM };
    enum { VARIED = Q + 3 * HAS_FLUX, INS = VARIED + ADDED };
    enum { OUTS = WHAT == FLUX ? 3 : WHAT == GAIN ? 1 : 5 };
    enum { S, OUTSIDE, A, NUMBERS = 1 + WHAT };

    // Of a cell and a face: D and L0 in the cell, kappa_s Q1 there along the face's normal, and the
    // radiance outside; what the face conducts, and what flows out through it.
    template <class N> struct Face {
        N diffusion, mean, flux, outside, conducted, outflow;
    };

    // The row in results, or in their cotangents; loss and conductances have so many colors.
    template <class P>
    INLINE static void rows_of(const Row& row, P* const* arrays, P** rows, int colors) {
        UNROLLED
        for (int k = 0; k < OUTS; ++k)
            rows[k] = arrays[k] + (k == 0 || WHAT == FLUX || colors > 1 ? row.at : row.start);
    }
    // kappa_s Q1 along an axis, where `read` reads: in a cell or beyond its face.
    template <class In, class N, class Read>
    INLINE static N flux_along(const In* in, const N* number, int axis, const Read& read) {
        if constexpr (!HAS_FLUX)
            return N(0);
        else
            return number[S] * read(in[SCATTERING]) * read(in[Q + MOMENT[axis]]);
    }
    template <class N> INLINE static N outside_of(const N* number) {
        if constexpr (WHAT == GAIN)
            return N(0);
        else
            return number[OUTSIDE];
    }
    // Finds what a face conducts and what flows out through it.
    template <class N, class M, class In, class Number> INLINE static void flow_out(
        Face<N>& face, const M& mesh, const In* in, const Number* number, int axis, int side,
        int i) {
        typedef typename M::Number F;
        const bool inside = mesh.inside(axis, side, i);
        const auto beyond = [&](const In& f) HERE { return mesh.beyond(f, axis, side, i); };
        const F h = mesh.h[axis], half = F(side ? 0.5 * ROOT : -0.5 * ROOT);
        face.conducted = conduct(face.diffusion, N(beyond(in[D])), h, inside);
        N driven = N(F(0));
        if constexpr (HAS_FLUX) {
            const N there = N(flux_along(in, number, axis, beyond));
            driven = half * pick(inside, N(face.flux + there), N(h * face.flux));
        }
        if constexpr (WHAT == FLUX) {
            const N there = N(beyond(in[MEAN]));
            driven += pick(inside, N((1 / h) * (face.mean - there)), N(face.mean - face.outside));
        } else if constexpr (IS_SYSTEM) {
            driven -= pick(inside, N(F(0)), face.outside);
        }
        face.outflow = face.conducted * driven;
    }

    // Out: moments of L1; or the right side, and of `has_matrix` loss and conductances.
    template <class N, class M, class In, class F> INLINE static void find(
        const Row& row, const M& mesh, const In* in, const N* number, F* const* out,
        bool has_matrix) {
        INDEPENDENT
        for (int i = 0; i < row.width; ++i) {
            const auto here = [&](const In& f) HERE { return f[i]; };
            N along[3], above[3], lost = N(F(0)), escape = N(F(0));
            UNROLLED
            for (int a = 0; a < 3; ++a) {
                const F per_h = 1 / mesh.h[a];
                Face<N> face;
                face.diffusion = in[D][i], face.outside = outside_of(number);
                if constexpr (WHAT == FLUX) face.mean = in[MEAN][i];
                face.flux = flux_along(in, number, a, here);
                UNROLLED
                for (int side = 0; side < 2; ++side) {
                    const bool inside = mesh.inside(a, side, i);
                    flow_out(face, mesh, in, number, a, side, i);
                    along[a] = side ? face.outflow - along[a] : face.outflow;
                    lost += per_h * face.outflow;
                    escape += pick(inside, N(F(0)), N(per_h * face.conducted));
                }
                const bool has_face = mesh.inside(a, 1, i) && mesh.conducts[a];
                above[a] = pick(has_face, N(per_h * per_h * face.conducted), N(F(0)));
            }
            if constexpr (WHAT == FLUX) {
                UNROLLED
                for (int a = 0; a < 3; ++a) {
                    N moment = F(1.5 / ROOT) * along[a];
                    if constexpr (ADDED > 0) moment += in[VARIED + MOMENT[a]][i];
                    out[MOMENT[a]][i] = change_of(moment);
                }
            } else {
                N right = -lost;
                UNROLLED
                for (int k = 0; k < ADDED; ++k) right += in[VARIED + k][i];
                if constexpr (IS_SYSTEM) {
                    right += number[S] * in[SCATTERING][i] * in[MEAN][i];
                    const N loss = number[A] * in[ABSORBING][i] + escape;
                    if (has_matrix) out[1][i] = change_of(loss);
                    UNROLLED
                    for (int a = 0; a < 3; ++a)
                        if (has_matrix) out[2 + a][i] = change_of(above[a]);
                }
                out[0][i] = change_of(right);
            }
        }
    }

    // Cotangents `out` of all fields but those added; and the row's part `sum` of those of numbers.
    // The slopes of what flows through a face, and of what it conducts, are those of dual numbers.
    template <class M, class F> INLINE static void find_back(
        const Row& row, const M& mesh, const F* const* in, const F* number, const F* const* bar,
        F* const* out, F* sum, bool has_matrix) {
        REORDERED
        typedef Dual<F, 4> N;
        F s_sum = 0, a_sum = 0, outside_sum = 0;
        SUMMING
        for (int i = 0; i < row.width; ++i) {
            const auto here = [&](const F* f) HERE { return f[i]; };
            F d_bar = 0, u_bar = 0, s_bar = 0;
            UNROLLED
            for (int a = 0; a < 3; ++a) {
                const F per_h = 1 / mesh.h[a];
                const F* const result_bar = bar[WHAT == FLUX ? MOMENT[a] : 0];
                F flux_bar = 0;
                Face<N> face;
                face.diffusion = N(in[D][i]), face.diffusion.by[0] = 1;
                face.mean = N(WHAT == FLUX ? in[HAS_MEAN ? MEAN : D][i] : F(0));
                face.mean.by[1] = 1;
                face.flux = N(flux_along(in, number, a, here)), face.flux.by[2] = 1;
                face.outside = N(outside_of(number)), face.outside.by[3] = 1;
                UNROLLED
                for (int side = 0; side < 2; ++side) {
                    const bool inside = mesh.inside(a, side, i);
                    flow_out(face, mesh, in, number, a, side, i);
                    const F there_bar = inside ? mesh.beyond(result_bar, a, side, i) : F(0);
                    const F outflow_bar =
                        WHAT == FLUX ? F((side ? 1.5 : -1.5) / ROOT) * (result_bar[i] + there_bar)
                                     : (there_bar - result_bar[i]) * per_h;
                    d_bar += outflow_bar * face.outflow.by[0];
                    u_bar += outflow_bar * face.outflow.by[1];
                    flux_bar += outflow_bar * face.outflow.by[2];
                    outside_sum += outflow_bar * face.outflow.by[3];
                    if constexpr (IS_SYSTEM) {
                        const F above_bar =
                            mesh.conducts[a] ? mesh.at_face(bar[2 + a], a, side, i) : F(0);
                        const F conducted_bar = per_h * (inside ? per_h * above_bar : bar[1][i]);
                        d_bar += has_matrix ? conducted_bar * face.conducted.by[0] : F(0);
                    }
                }
                if constexpr (HAS_FLUX) {
                    s_bar += flux_bar * in[Q + MOMENT[a]][i];
                    out[Q + MOMENT[a]][i] = number[S] * in[SCATTERING][i] * flux_bar;
                }
            }
            if constexpr (IS_SYSTEM) {
                s_bar += in[MEAN][i] * bar[0][i];
                u_bar = number[S] * in[SCATTERING][i] * bar[0][i];
                const F loss_bar = has_matrix ? bar[1][i] : F(0);
                out[ABSORBING][i] = number[A] * loss_bar;
                a_sum += in[ABSORBING][i] * loss_bar;
            }
            s_sum += in[SCATTERING][i] * s_bar;
            out[D][i] = d_bar;
            out[SCATTERING][i] = number[S] * s_bar;
            if constexpr (HAS_MEAN) out[MEAN][i] = u_bar;
        }
        sum[S] = s_sum;
        if constexpr (HAS_MEAN) sum[OUTSIDE] = outside_sum;
        if constexpr (IS_SYSTEM) sum[A] = a_sum;
    }
};

// What an item does: its row's values, or changes where N are dual numbers; or cotangents.
template <class Flow, class N, class F> INLINE void find_values(
    const Row& row, const Mesh<F>& mesh, int colors, const int* channels, const F* const* fields,
    const F* const* d_fields, const F* numbers, const F* d_numbers, F* const* results) {
    const Inputs<N, Flow::INS, Flow::NUMBERS, F> inputs(
        row, channels, fields, d_fields, numbers, d_numbers);
    F* out[Flow::OUTS];
    Flow::rows_of(row, results, out, colors);
    mesh.visit([&](const auto& mesh) HERE {
        Flow::find(row, mesh, inputs.in, inputs.number, out, row.color < colors);
    });
}
template <class Flow, class F> INLINE void find_cotangents(
    const Row& row, const Mesh<F>& mesh, int colors, const int* channels, const F* const* fields,
    const F* numbers, const F* const* bars, F* const* results, F* sums) {
    const F *in[Flow::VARIED], *bar[Flow::OUTS];
    F number[Flow::NUMBERS], sum[Flow::NUMBERS], *out[Flow::VARIED];
    row.in_all<Flow::VARIED>(fields, channels, in);
    row.of_color<Flow::NUMBERS>(numbers, number);
    row.in_all<Flow::VARIED>(results, out);
    Flow::rows_of(row, bars, bar, colors);
    mesh.visit([&](const auto& mesh) HERE {
        Flow::find_back(row, mesh, in, number, bar, out, sum, row.color < colors);
    });
    for (int k = 0; k < Flow::NUMBERS; ++k) sums[k * row.items + row.item] = sum[k];
}

} // namespace ddrecon
