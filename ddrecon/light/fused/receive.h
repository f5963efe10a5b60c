#pragma once
#include "ddrecon/kernels/dual.h"
// The light that cells receive of beams, by its moments in angle: in color c that is
// tau = exp(-scale entered) phi(scale step field), the transmittance averaged over the cell along
// the beam, times the beam's weights.

namespace ddrecon {

// exp(-mass) phi(depth).
template <class N> INLINE N transmit(const N& mass, const N& depth) {
    const auto clear = decay(value_of(mass));
    const auto cell = decayed(value_of(depth));
    typedef Sloped<decltype(cell.phi + clear)> Function;
    return along(mass, Function{clear, -clear}) *
           along(depth, Function{cell.phi, cell.psi - cell.phi});
}

// What all beams have: fields [channels, cells], and numbers [lights, 2 + moments, colors] of each,
// which are the scale, scale times step, and weights. An item is a CHUNK of cells.
template <class F, int CHUNK> struct Receiver {
    long long cells;
    int channels, colors, moments, lights;

    INLINE int count_from(long long begin) const {
        return begin + CHUNK < cells ? CHUNK : (int)(cells - begin);
    }
    INLINE int number(int i, int k, int c) const { return (i * (2 + moments) + k) * colors + c; }
    // Where moment number a in color c begins.
    INLINE long long moment(int a, int c) const { return ((long long)a * colors + c) * cells; }

    // Writes moments `phi` of what is received of at most BEAMS beams; as dual numbers N, read from
    // `In`, their changes.
    template <class N, int BEAMS, class In>
    INLINE void receive(int item, In field, In entered, In numbers, F* phi) const {
        const long long begin = (long long)item * CHUNK;
        const int count = count_from(begin);
        for (int c = 0; c < colors; ++c) {
            const long long channel = channels == 1 ? 0 : c;
            const In f = field + (channel * cells + begin);
            N tau[BEAMS][CHUNK];
            for (int i = 0; i < lights; ++i) {
                const In e = entered + ((i * channels + channel) * cells + begin);
                const N scale = numbers[number(i, 0, c)], path = numbers[number(i, 1, c)];
                INDEPENDENT
                for (int t = 0; t < count; ++t) tau[i][t] = transmit(scale * e[t], path * f[t]);
            }
            for (int a = 0; a < moments; ++a) {
                N sums[CHUNK];
                for (int t = 0; t < count; ++t) sums[t] = N(F(0));
                for (int i = 0; i < lights; ++i) {
                    const N weight = numbers[number(i, 2 + a, c)];
                    INDEPENDENT
                    for (int t = 0; t < count; ++t) sums[t] += weight * tau[i][t];
                }
                F* __restrict out = phi + moment(a, c) + begin;
                for (int t = 0; t < count; ++t) out[t] = change_of(sums[t]);
            }
        }
    }

    // Adds the field's cotangent, and writes that of what `entered`; where numbers `vary`, `sums`
    // of theirs over the item's cells.
    INLINE void receive_back(
        int item, int first_item, bool vary, const F* field, const F* entered, const F* numbers,
        const F* bars, F* field_bar, F* entered_bar, double* sums) const {
        const long long begin = ((long long)item + first_item) * CHUNK;
        const int count = count_from(begin);
        double* sum = sums + (long long)item * lights * (2 + moments) * colors;
        for (int i = 0; i < lights * channels; ++i) {
            const int light = i / channels, channel = i % channels;
            const F* __restrict e = entered + i * cells + begin;
            const F* __restrict f = field + channel * cells + begin;
            F* __restrict e_bar = entered_bar + i * cells + begin;
            F* __restrict f_bar = field_bar + channel * cells + begin;
            for (int t = 0; t < count; ++t) e_bar[t] = F(0);
            const int last = channels == 1 ? colors : channel + 1;
            for (int c = channels == 1 ? 0 : channel; c < last; ++c) {
                const F scale = numbers[number(light, 0, c)], path = numbers[number(light, 1, c)];
                F tau_bar[CHUNK], tau[CHUNK], of_scale[CHUNK], of_path[CHUNK];
                for (int t = 0; t < count; ++t) tau_bar[t] = F(0);
                for (int a = 0; a < moments; ++a) {
                    const F w = numbers[number(light, 2 + a, c)];
                    const F* __restrict bar = bars + moment(a, c) + begin;
                    for (int t = 0; t < count; ++t) tau_bar[t] += w * bar[t];
                }
                for (int t = 0; t < count; ++t) {
                    Dual<F, 2> mass(scale * e[t]), depth(path * f[t]);
                    mass.by[0] = depth.by[1] = F(1);
                    const Dual<F, 2> transmitted = transmit(mass, depth);
                    const F mass_bar = transmitted.by[0] * tau_bar[t];
                    const F depth_bar = transmitted.by[1] * tau_bar[t];
                    tau[t] = transmitted.value;
                    e_bar[t] += scale * mass_bar, f_bar[t] += path * depth_bar;
                    of_scale[t] = e[t] * mass_bar, of_path[t] = f[t] * depth_bar;
                }
                if (!vary) continue;
                sum[number(light, 0, c)] = total(of_scale, count);
                sum[number(light, 1, c)] = total(of_path, count);
                for (int a = 0; a < moments; ++a) {
                    const F* __restrict bar = bars + moment(a, c) + begin;
                    for (int t = 0; t < count; ++t) of_scale[t] = bar[t] * tau[t];
                    sum[number(light, 2 + a, c)] = total(of_scale, count);
                }
            }
        }
    }
};

} // namespace ddrecon
