#pragma once
#include "ddrecon/kernels/dual.h"
// The light that cells receive of beams, by its moments in angle: in color c that is
// tau = exp(-scale entered) phi(scale field step), the transmittance averaged over the cell along
// the beam, times the beam's weights.

namespace ddrecon {

// exp(-mass) phi(depth), with its slopes by both.
template <class F> struct Visible {
    F value, by_mass, by_depth;
    INLINE Visible(F mass, F depth) {
        const F clear = decay(mass);
        const Decayed<F> cell = decayed(depth);
        value = clear * cell.phi;
        by_mass = -value;
        by_depth = clear * (cell.psi - cell.phi);
    }
};
template <class F> INLINE F visible(F mass, F depth) { return Visible<F>(mass, depth).value; }
template <class F> INLINE Dual<F> visible(const Dual<F>& mass, const Dual<F>& depth) {
    const Visible<F> found(mass.value, depth.value);
    return mass.chain(found.value, found.by_mass, depth, found.by_depth);
}

// What all beams have: fields [channels, cells], weights [lights, moments, colors], and the path of
// each in a slice, `steps`. An item is a CHUNK of cells.
template <class F, int CHUNK> struct Receiver {
    long long cells;
    int channels, colors, moments, lights;

    INLINE int count_from(long long begin) const {
        return begin + CHUNK < cells ? CHUNK : (int)(cells - begin);
    }
    INLINE int weight(int i, int a, int c) const { return (i * moments + a) * colors + c; }
    // Where moment number a in color c begins.
    INLINE long long moment(int a, int c) const { return ((long long)a * colors + c) * cells; }

    // Writes to moments `made` what is received of at most BEAMS beams; as dual numbers N, given as
    // `In`, its change.
    template <class N, int BEAMS, class In> INLINE void receive(
        int item, In field, In scale, In entered, In steps, In weights, F* made) const {
        const long long begin = (long long)item * CHUNK;
        const int count = count_from(begin);
        for (int c = 0; c < colors; ++c) {
            const N s = scale[c];
            const long long channel = channels == 1 ? 0 : c;
            const In f = field + (channel * cells + begin);
            N seen[BEAMS][CHUNK];
            for (int i = 0; i < lights; ++i) {
                const In e = entered + ((i * channels + channel) * cells + begin);
                const N along = s * steps[i];
                INDEPENDENT
                for (int t = 0; t < count; ++t) seen[i][t] = visible(s * e[t], along * f[t]);
            }
            for (int a = 0; a < moments; ++a) {
                N sums[CHUNK];
                for (int t = 0; t < count; ++t) sums[t] = N(F(0));
                const auto own = [&](int i) HERE { return N(weights[weight(i, a, c)]); };
                int i = 0;
                // Of many beams four at a time.
                for (; i + 4 <= lights; i += 4) {
                    const N one = own(i), two = own(i + 1), three = own(i + 2), four = own(i + 3);
                    INDEPENDENT
                    for (int t = 0; t < count; ++t)
                        sums[t] += one * seen[i][t] + two * seen[i + 1][t] +
                                   three * seen[i + 2][t] + four * seen[i + 3][t];
                }
                for (; i < lights; ++i) {
                    const N one = own(i);
                    INDEPENDENT
                    for (int t = 0; t < count; ++t) sums[t] += one * seen[i][t];
                }
                F* __restrict out = made + moment(a, c) + begin;
                for (int t = 0; t < count; ++t) out[t] = change_of(sums[t]);
            }
        }
    }

    // Adds the field's cotangent, and writes that of what `entered`; where it `varies`, `sums`
    // [lights, 1 + (1 + moments) colors] of the step, scales and weights.
    INLINE void receive_back(
        int item, int first_item, bool varies, const F* field, const F* scale, const F* entered,
        const F* steps, const F* weights, const F* bars, F* field_bar, F* entered_bar,
        double* sums) const {
        const long long begin = ((long long)item + first_item) * CHUNK;
        const int count = count_from(begin);
        for (int i = 0; i < lights * channels; ++i) {
            const int one = i / channels, channel = i % channels;
            const F* __restrict e = entered + i * cells + begin;
            const F* __restrict f = field + channel * cells + begin;
            const F own_step = steps[one];
            double* found = sums + ((long long)item * lights + one) * (1 + (1 + moments) * colors);
            F of_entered[CHUNK], of_field[CHUNK], of_step[CHUNK];
            for (int t = 0; t < count; ++t) of_entered[t] = of_field[t] = F(0);
            const int last = channels == 1 ? colors : channel + 1;
            for (int c = channels == 1 ? 0 : channel; c < last; ++c) {
                const F s = scale[c];
                F bar[CHUNK], seen[CHUNK], of_scale[CHUNK];
                for (int t = 0; t < count; ++t) bar[t] = F(0);
                for (int a = 0; a < moments; ++a) {
                    const F own = weights[weight(one, a, c)];
                    const F* __restrict from = bars + moment(a, c) + begin;
                    for (int t = 0; t < count; ++t) bar[t] += own * from[t];
                }
                for (int t = 0; t < count; ++t) {
                    const F path = own_step * f[t];
                    const Visible<F> tau(s * e[t], s * path);
                    const F mass_bar = tau.by_mass * bar[t], depth_bar = tau.by_depth * bar[t];
                    seen[t] = tau.value;
                    of_entered[t] += s * mass_bar;
                    of_field[t] += s * own_step * depth_bar;
                    of_scale[t] = path * depth_bar + e[t] * mass_bar;
                    of_step[t] = s * f[t] * depth_bar;
                }
                if (!varies) continue;
                found[0] += total(of_step, count);
                found[1 + c] = total(of_scale, count);
                for (int a = 0; a < moments; ++a) {
                    const F* __restrict from = bars + moment(a, c) + begin;
                    for (int t = 0; t < count; ++t) of_scale[t] = from[t] * seen[t];
                    found[1 + (1 + a) * colors + c] = total(of_scale, count);
                }
            }
            F* __restrict out = entered_bar + i * cells + begin;
            F* __restrict of_cell = field_bar + channel * cells + begin;
            for (int t = 0; t < count; ++t) out[t] = of_entered[t];
            for (int t = 0; t < count; ++t) of_cell[t] += of_field[t];
        }
    }
};

} // namespace ddrecon
