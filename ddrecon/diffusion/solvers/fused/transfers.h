#pragma once
#include "ddrecon/diffusion/solvers/fused/levels.h"
// Transfers between grids, of one slice each (`solvers/coarsening.py`).

namespace ddrecon {

// Sum of a pair, less what its outer cells send to the pairs beside it, plus what those send.
template <class F> APART void restrict_pair(
    const F* __restrict before, const F* __restrict one, const F* __restrict two,
    const F* __restrict after, const Weights<F>& last, const Weights<F>& own, F* __restrict out,
    Size count) {
    const F* __restrict below_before = last.below;
    const F* __restrict above_before = last.above;
    const F* __restrict below = own.below;
    const F* __restrict above = own.above;
    for (Size i = 0; i < count; ++i)
        out[i] = one[i] + two[i] - (below[i] * two[i] - above[i] * after[i]) +
                 (below_before[i] * before[i] - above_before[i] * one[i]);
}
template <class F> APART void restrict_y(
    const F* in, F* out, const Weights<F>& weights, const F* zero, int ny, int nx) {
    for (int j = 0; 2 * j < ny; ++j) {
        const F *one = in + (Size)2 * j * nx, *before = j > 0 ? one - nx : zero;
        const F* two = 2 * j + 1 < ny ? one + nx : zero;
        const F* after = 2 * j + 2 < ny ? one + 2 * nx : zero;
        const Weights<F> own = weights + (Size)j * nx;
        const Weights<F> last = j > 0 ? own + -nx : Weights<F>{zero, zero};
        restrict_pair(before, one, two, after, last, own, out + (Size)j * nx, (Size)nx);
    }
}
template <class F>
APART void restrict_x(const F* in, F* out, const Weights<F>& weights, int rows, int nx) {
    const int coarse = (nx + 1) / 2;
    for (int j = 0; j < rows; ++j) {
        const F* __restrict r = in + (Size)j * nx;
        const F* __restrict b = weights.below + (Size)j * coarse;
        const F* __restrict a = weights.above + (Size)j * coarse;
        F* __restrict o = out + (Size)j * coarse;
        const auto end = [&](int i) {
            F sum = r[2 * i];
            if (2 * i + 1 < nx) sum += r[2 * i + 1];
            if (2 * i + 2 < nx) sum -= b[i] * r[2 * i + 1] - a[i] * r[2 * i + 2];
            if (i > 0) sum += b[i - 1] * r[2 * i - 1] - a[i - 1] * r[2 * i];
            o[i] = sum;
        };
        end(0);
        for (int i = 1; i < coarse - 1; ++i)
            o[i] = r[2 * i] + r[2 * i + 1] - (b[i] * r[2 * i + 1] - a[i] * r[2 * i + 2]) +
                   (b[i - 1] * r[2 * i - 1] - a[i - 1] * r[2 * i]);
        if (coarse > 1) end(coarse - 1);
    }
}
// From the nearer and the farther of two rows.
template <class F> APART void prolong_pair(
    const F* __restrict near, const F* __restrict far, const F* __restrict weight,
    F* __restrict out, Size count) {
    for (Size i = 0; i < count; ++i) out[i] = near[i] + weight[i] * (far[i] - near[i]);
}
template <class F>
APART void prolong_y(const F* in, F* out, const Weights<F>& weights, int ny, int nx) {
    const int coarse = (ny + 1) / 2;
    for (int j = 0; j < ny; ++j) {
        // towards the pair below or above; at the ends there is none, and the difference is zero
        const int k = j / 2, to = j & 1 ? (k + 1 < coarse ? k + 1 : k) : (k > 0 ? k - 1 : k);
        const F* w = j & 1 ? weights.below + (Size)k * nx : weights.above + (Size)to * nx;
        prolong_pair(in + (Size)k * nx, in + (Size)to * nx, w, out + (Size)j * nx, (Size)nx);
    }
}
template <class F>
APART void prolong_x(const F* in, F* out, const Weights<F>& weights, int rows, int nx) {
    const int coarse = (nx + 1) / 2;
    for (int j = 0; j < rows; ++j) {
        const F* __restrict u = in + (Size)j * coarse;
        const F* __restrict b = weights.below + (Size)j * coarse;
        const F* __restrict a = weights.above + (Size)j * coarse;
        F* __restrict o = out + (Size)j * nx;
        o[0] = u[0];
        for (int i = 0; i < coarse - 1; ++i) {
            const F rise = u[i + 1] - u[i];
            o[2 * i + 1] = u[i] + b[i] * rise;
            o[2 * i + 2] = u[i + 1] - a[i] * rise;
        }
        if (2 * coarse == nx) o[nx - 1] = u[coarse - 1];
    }
}

} // namespace ddrecon
