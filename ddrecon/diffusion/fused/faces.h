#pragma once
#include "ddrecon/diffusion/fused/mesh.h"
// What flows through the faces of cells (E2.5 to E2.7 of docs/theory.md). A cell goes through all
// six of its faces: for what it gains, and in the other direction for what its numbers count.

namespace ddrecon {

// What a face conducts, with its slopes: the harmonic mean of D here and there (E2.7), and on the
// box 1 / (2 + h / (2 D)) (E2.6). Times 1 / h^2, or 1 / h on the box, it is what the matrix has.
template <class F> struct Conduction {
    F value, by_here, by_there;
};
template <class F> INLINE Conduction<F> conduct(F here, F there, F h, bool inside) {
    const F inverse = 1 / (inside ? here + there : 4 * here + h);
    const F share = (inside ? there : F(1)) * inverse, other = inside ? here * inverse : F(0);
    return {2 * here * share, 2 * share * share * (inside ? F(1) : h), 2 * other * other};
}
template <class F> INLINE F conducted(F here, F there, F h, bool inside) {
    return conduct(here, there, h, inside).value;
}
template <class F>
INLINE Dual<F> conducted(const Dual<F>& here, const Dual<F>& there, F h, bool inside) {
    const Conduction<F> c = conduct(here.value, there.value, h, inside);
    return here.chain(c.value, c.by_here, there, c.by_there);
}

// Which moment of degree 1 is along z, y and x; and how many times that a flux is (`moments.py`).
constexpr int MOMENT[3] = {1, 0, 2};
constexpr double ROOT = 1.7320508075688772;

enum { GAIN, FLUX, SYSTEM };
// What cells gain from Q1, -div(D kappa_s Q1), or L1 (E2.5), or all of E2.7. Given are fields: D,
// kappa_s but for its scale; then, unless it is a gain, L0 or Q0; kappa_a, unless it has the field
// of kappa_s (SHARED); the moments of Q1, as a sum of so many FLUXES; and as many as are BEGUN, to
// which what is found is added. And numbers: the scale of kappa_s, the radiance outside, the
// scale of kappa_a.
template <int WHAT, int FLUXES, int BEGUN, bool SHARED> struct Flow {
    static constexpr bool HAS_MEAN = WHAT != GAIN, IS_SYSTEM = WHAT == SYSTEM;
    enum {
        D,
        SCATTERING,
        MEAN,
        ABSORBING = SHARED ? 1 : 3,
        Q = 2 + HAS_MEAN + (IS_SYSTEM && !SHARED)
    };
    enum { GIVEN = Q + 3 * FLUXES, INS = GIVEN + BEGUN, MADE = FLUXES ? Q + 3 : Q };
    enum { OUTS = WHAT == FLUX ? 3 : WHAT == GAIN ? 1 : 5 };
    enum { S, OUTSIDE, A, NUMBERS = 1 + WHAT };

    // The row in what is found, or in its cotangents; loss and conductances have `own` colors.
    template <class P>
    INLINE static void rows_of(const Row& row, P* const* arrays, P** found, int own) {
        UNROLLED
        for (int k = 0; k < OUTS; ++k)
            found[k] = arrays[k] + (k == 0 || WHAT == FLUX || own > 1 ? row.at : row.start);
    }
    // Q1 along an axis, where `at` reads: in this cell or beyond its face.
    template <class In, class At> INLINE static auto flux(const In* in, int axis, At at) {
        auto q = at(in[Q + MOMENT[axis]]);
        UNROLLED
        for (int k = 1; k < FLUXES; ++k) q += at(in[Q + 3 * k + MOMENT[axis]]);
        return q;
    }
    // What drives light out of a cell through a face, which then conducts it.
    template <class N, class M, class In>
    INLINE static N drive(const M& mesh, const In* in, const N* number, int axis, int side, int i) {
        const bool inside = mesh.inside(axis, side, i);
        typedef typename M::Number F;
        const F h = mesh.h[axis], half = F(side ? 0.5 * ROOT : -0.5 * ROOT);
        N driven = F(0);
        if constexpr (FLUXES > 0) {
            const N here =
                in[SCATTERING][i] * flux(in, axis, [&](const In& f) HERE { return f[i]; });
            const N there =
                mesh.beyond(in[SCATTERING], axis, side, i) *
                flux(in, axis, [&](const In& f) HERE { return mesh.beyond(f, axis, side, i); });
            driven = half * number[S] * pick(inside, N(here + there), N(h * here));
        }
        if constexpr (WHAT == FLUX) {
            const N u = in[MEAN][i], there = mesh.beyond(in[MEAN], axis, side, i);
            driven += pick(inside, N((1 / h) * (u - there)), N(u - number[OUTSIDE]));
        } else if constexpr (IS_SYSTEM) {
            driven -= pick(inside, N(F(0)), number[OUTSIDE]);
        }
        return driven;
    }

    // Out: moments of L1; or the right side, and of `is_own` loss and conductances.
    template <class N, class M, class In, class F> INLINE static void find(
        const Row& row, const M& mesh, const In* in, const N* number, F* const* out, bool is_own,
        F times) {
        INDEPENDENT
        for (int i = 0; i < row.width; ++i) {
            N along[3], above[3], lost = F(0), escape = F(0);
            UNROLLED
            for (int a = 0; a < 3; ++a) {
                const F per_h = 1 / mesh.h[a];
                UNROLLED
                for (int side = 0; side < 2; ++side) {
                    const bool inside = mesh.inside(a, side, i);
                    const N there = mesh.beyond(in[D], a, side, i);
                    const N c = conducted<F>(in[D][i], there, mesh.h[a], inside);
                    const N flow = c * drive(mesh, in, number, a, side, i);
                    along[a] = side ? flow - along[a] : flow;
                    lost += per_h * flow;
                    escape += pick(inside, N(F(0)), N(per_h * c));
                    above[a] = pick(inside && mesh.conducts[a], N(per_h * per_h * c), N(F(0)));
                }
            }
            if constexpr (WHAT == FLUX) {
                UNROLLED
                for (int a = 0; a < 3; ++a) {
                    N moment = F(1.5 / ROOT) * times * along[a];
                    if constexpr (BEGUN > 0) moment += in[GIVEN + MOMENT[a]][i];
                    out[MOMENT[a]][i] = change_of(moment);
                }
            } else {
                N right = -lost;
                UNROLLED
                for (int k = 0; k < BEGUN; ++k) right += in[GIVEN + k][i];
                if constexpr (IS_SYSTEM) {
                    right += number[S] * in[SCATTERING][i] * in[MEAN][i];
                    const N loss = number[A] * in[ABSORBING][i] + escape;
                    if (is_own) out[1][i] = change_of(loss);
                    UNROLLED
                    for (int a = 0; a < 3; ++a)
                        if (is_own) out[2 + a][i] = change_of(above[a]);
                }
                out[0][i] = change_of(right);
            }
        }
    }

    // Cotangents `out` of the fields but for what is begun, and of one of the fluxes; and the row's
    // part `sum` of those of numbers.
    template <class M, class F> INLINE static void find_back(
        const Row& row, const M& mesh, const F* const* in, const F* number, const F* const* bar,
        F* const* out, F* sum, bool is_own, F times) {
        REORDERED
        F of_s = 0, of_a = 0, of_outside = 0;
        SUMMING
        for (int i = 0; i < row.width; ++i) {
            const F loss_bar = IS_SYSTEM && is_own ? bar[1][i] : F(0),
                    s = number[S] * in[SCATTERING][i];
            F d_bar = 0, s_bar = 0, u_bar = 0, a_bar = 0, q_bar[3];
            UNROLLED
            for (int a = 0; a < 3; ++a) {
                const F h = mesh.h[a], per_h = 1 / h;
                const F* const r = bar[WHAT == FLUX ? MOMENT[a] : 0];
                F p_bar = 0;
                UNROLLED
                for (int side = 0; side < 2; ++side) {
                    const bool inside = mesh.inside(a, side, i);
                    const Conduction<F> c =
                        conduct(in[D][i], mesh.beyond(in[D], a, side, i), h, inside);
                    const F there = inside ? mesh.beyond(r, a, side, i) : F(0);
                    // Of what flows out through this face, and of what it conducts.
                    const F flow_bar = WHAT == FLUX
                                           ? F((side ? 1.5 : -1.5) / ROOT) * times * (r[i] + there)
                                           : (there - r[i]) * per_h;
                    F c_bar = flow_bar * drive(mesh, in, number, a, side, i);
                    if constexpr (IS_SYSTEM) {
                        const F face_bar = is_own && mesh.conducts[a]
                                               ? mesh.at_face(bar[2 + a], a, side, i)
                                               : F(0);
                        c_bar += inside ? per_h * per_h * face_bar : per_h * loss_bar;
                    }
                    const F drive_bar = c.value * flow_bar;
                    d_bar += c.by_here * c_bar;
                    p_bar += (inside ? F(1) : h) * F(side ? 0.5 * ROOT : -0.5 * ROOT) * drive_bar;
                    u_bar += (inside ? per_h : F(1)) * drive_bar;
                    of_outside -= inside ? F(0) : drive_bar;
                }
                if constexpr (FLUXES > 0)
                    s_bar += p_bar * flux(in, a, [&](const F* f) HERE { return f[i]; });
                q_bar[MOMENT[a]] = s * p_bar;
            }
            if constexpr (IS_SYSTEM) {
                s_bar += in[MEAN][i] * bar[0][i];
                u_bar = s * bar[0][i];
                a_bar = number[A] * loss_bar;
                of_a += in[ABSORBING][i] * loss_bar;
            }
            of_s += in[SCATTERING][i] * s_bar;
            out[D][i] = d_bar;
            out[SCATTERING][i] = number[S] * s_bar + (SHARED ? a_bar : F(0));
            if constexpr (HAS_MEAN) out[MEAN][i] = u_bar;
            if constexpr (IS_SYSTEM && !SHARED) out[ABSORBING][i] = a_bar;
            UNROLLED
            for (int a = 0; a < (FLUXES ? 3 : 0); ++a) out[Q + a][i] = q_bar[a];
        }
        sum[S] = of_s;
        if constexpr (HAS_MEAN) sum[OUTSIDE] = of_outside;
        if constexpr (IS_SYSTEM) sum[A] = of_a;
    }
};

// What an item does: its row's values, or changes where N are dual numbers; or cotangents.
template <class Flow, class N, class F> INLINE void find_values(
    const Row& row, const Mesh<F>& mesh, int own, F times, const int* channels,
    const F* const* fields, const F* const* d_fields, const F* numbers, const F* d_numbers,
    F* const* made) {
    const Inputs<N, Flow::INS, Flow::NUMBERS, F> given(
        row, channels, fields, d_fields, numbers, d_numbers);
    F* out[Flow::OUTS];
    Flow::rows_of(row, made, out, own);
    mesh.visit([&](const auto& mesh) HERE {
        Flow::find(row, mesh, given.in, given.number, out, row.color < own, times);
    });
}
template <class Flow, class F> INLINE void find_cotangents(
    const Row& row, const Mesh<F>& mesh, int own, F times, const int* channels,
    const F* const* fields, const F* numbers, const F* const* bars, F* const* made, F* sums) {
    const F *in[Flow::GIVEN], *bar[Flow::OUTS];
    F number[Flow::NUMBERS], sum[Flow::NUMBERS], *out[Flow::MADE];
    row.in_all<Flow::GIVEN>(fields, channels, in);
    row.of_color<Flow::NUMBERS>(numbers, number);
    row.in_all<Flow::MADE>(made, out);
    Flow::rows_of(row, bars, bar, own);
    mesh.visit([&](const auto& mesh) HERE {
        Flow::find_back(row, mesh, in, number, bar, out, sum, row.color < own, times);
    });
    for (int k = 0; k < Flow::NUMBERS; ++k) sums[k * row.items + row.item] = sum[k];
}

} // namespace ddrecon
