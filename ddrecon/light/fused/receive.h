#pragma once
#include "ddrecon/kernels/dual.h"
// The light that cells receive of beams, by its moments in angle: in color c that is
// tau = exp(-scale entered) phi(scale field step), the transmittance averaged over the cell along
// the beam, times the beam's weights.

namespace ddrecon {

// exp(-mass) phi(depth).
template <class N> INLINE N visible(const N& mass, const N& depth) {
    const auto clear = decay(value_of(mass));
    const auto cell = decayed(value_of(depth));
    typedef Sloped<decltype(cell.phi + clear)> Function;
    return along(mass, Function{clear, -clear}) *
           along(depth, Function{cell.phi, cell.psi - cell.phi});
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

    // Writes moments `phi` of what is received of at most BEAMS beams; as dual numbers N, given as
    // `In`, their changes.
    template <class N, int BEAMS, class In> INLINE void receive(
        int item, In field, In scale, In entered, In steps, In weights, F* phi) const {
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
                const auto by = [&](int i) HERE { return N(weights[weight(i, a, c)]); };
                int i = 0;
                // Of many beams four at a time.
                for (; i + 4 <= lights; i += 4) {
                    const N w0 = by(i), w1 = by(i + 1), w2 = by(i + 2), w3 = by(i + 3);
                    INDEPENDENT
                    for (int t = 0; t < count; ++t)
                        sums[t] += w0 * seen[i][t] + w1 * seen[i + 1][t] + w2 * seen[i + 2][t] +
                                   w3 * seen[i + 3][t];
                }
                for (; i < lights; ++i) {
                    const N w = by(i);
                    INDEPENDENT
                    for (int t = 0; t < count; ++t) sums[t] += w * seen[i][t];
                }
                F* __restrict out = phi + moment(a, c) + begin;
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
            const int light = i / channels, channel = i % channels;
            const F* __restrict e = entered + i * cells + begin;
            const F* __restrict f = field + channel * cells + begin;
            F* __restrict e_bar = entered_bar + i * cells + begin;
            F* __restrict f_bar = field_bar + channel * cells + begin;
            double* sum = sums + ((long long)item * lights + light) * (1 + (1 + moments) * colors);
            for (int t = 0; t < count; ++t) e_bar[t] = F(0);
            const int last = channels == 1 ? colors : channel + 1;
            for (int c = channels == 1 ? 0 : channel; c < last; ++c) {
                const F s = scale[c], step = s * steps[light];
                F bar[CHUNK], seen[CHUNK], of_scale[CHUNK], of_step[CHUNK];
                for (int t = 0; t < count; ++t) bar[t] = F(0);
                for (int a = 0; a < moments; ++a) {
                    const F w = weights[weight(light, a, c)];
                    const F* __restrict from = bars + moment(a, c) + begin;
                    for (int t = 0; t < count; ++t) bar[t] += w * from[t];
                }
                for (int t = 0; t < count; ++t) {
                    Dual<F, 2> mass(s * e[t]), depth(step * f[t]);
                    mass.by[0] = depth.by[1] = F(1);
                    const Dual<F, 2> tau = visible(mass, depth);
                    const F mass_bar = tau.by[0] * bar[t], depth_bar = tau.by[1] * bar[t];
                    seen[t] = tau.value;
                    e_bar[t] += s * mass_bar;
                    f_bar[t] += step * depth_bar;
                    of_scale[t] = steps[light] * f[t] * depth_bar + e[t] * mass_bar;
                    of_step[t] = s * f[t] * depth_bar;
                }
                if (!varies) continue;
                sum[0] += total(of_step, count);
                sum[1 + c] = total(of_scale, count);
                for (int a = 0; a < moments; ++a) {
                    const F* __restrict from = bars + moment(a, c) + begin;
                    for (int t = 0; t < count; ++t) of_scale[t] = from[t] * seen[t];
                    sum[1 + (1 + a) * colors + c] = total(of_scale, count);
                }
            }
        }
    }
};

} // namespace ddrecon
