#pragma once
#include "ddrecon/march/fused/runs.h"
// Pixels between the rays of a lattice: values, and their adjoint. An item is some pixels. Pixels
// go in packets, as rays do; the lattice is a slice whose cells are its rays, and values are to
// third order (`numerics/third_order.py`).

namespace ddrecon {

// `values` [channels, rows, columns] of the lattice, and `places` [total, 2] there of the pixels
// `hit` [total], of so many `pixels` that rows of an image's channels have.
template <class F> struct Pixels {
    typedef Packets<F> P;
    typedef typename P::V V;
    const F* values;
    int channels, rows, columns, length, total, pixels;
    const F* places;
    const long long* hit;

    struct Packet : Spot<F, true, V> {
        Runs<F> runs;
    };
    INLINE int end(int item) const {
        return (item + 1) * length < total ? (item + 1) * length : total;
    }
    INLINE Lines lines() const { return {rows, columns, columns, 1}; }
    INLINE const F* channel(int k) const { return values + k * rows * columns; }
    INLINE Packet packet_at(int n) const {
        Packet packet;
        packet.y = Place<F, V>::at(P::load(places, n, 2, total - 1), rows);
        packet.x = Place<F, V>::at(P::load(places + 1, n, 2, total - 1), columns);
        packet.runs.find(packet.y, packet.x, lines());
        return packet;
    }
    INLINE V value_at(const Packet& packet, const F* v) const {
        V bend = P::all(F(0)), value = bend;
#if !defined(__CUDA_ARCH__)
        if constexpr (HAS_PERMUTATION<F>)
            if (packet.runs.count <= MOST_RUNS && columns >= LANES) {
                for (int r = 0; r < packet.runs.count; ++r) {
                    const Window<F> w(packet.runs.run[r], packet.y, packet.x, lines());
                    const V found = w.value(v, true, bend);
                    value = P::pick(w.is_in, found - bend, value);
                }
                return value;
            }
#endif
        value = packet.value(v, lines(), true, bend);
        return value - bend;
    }

    // Whether pixels n on, as many as lanes, are neighbors in an image.
    INLINE bool is_whole(int n, int end) const {
        return n + LANES <= end && hit[n + LANES - 1] - hit[n] == LANES - 1;
    }
    // To `out` [channels, pixels].
    void interpolate(int item, F* out) const {
        const int end = this->end(item);
        for (int n = item * length; n < end; n += LANES) {
            const Packet packet = packet_at(n);
            for (int k = 0; k < channels; ++k) {
                const V value = P::most(value_at(packet, channel(k)), P::all(F(0)));
                F* row = out + k * (long long)pixels;
                if (is_whole(n, end))
                    P::write(row + hit[n], value);
                else
                    for (int l = 0; l < LANES && n + l < end; ++l)
                        row[hit[n + l]] = P::lane(value, l);
            }
        }
    }
    // Adds to `values_bar` what `out_bar` is for the values.
    void spread(int item, const F* out_bar, F* values_bar) const {
        // So many channels at a time.
        constexpr int MOST = 6;
        const int end = this->end(item), size = rows * columns;
        for (int n = item * length; n < end; n += LANES) {
            const Packet packet = packet_at(n);
            for (int first = 0; first < channels; first += MOST) {
                const int count = channels - first < MOST ? channels - first : MOST;
                V bars[MOST];
                for (int k = 0; k < count; ++k) {
                    const F* row = out_bar + (first + k) * (long long)pixels;
                    V bar = P::all(F(0));
                    if (is_whole(n, end))
                        bar = P::read(row + hit[n]);
                    else
                        for (int l = 0; l < LANES && n + l < end; ++l)
                            P::put(bar, l, row[hit[n + l]]);
                    // What was clamped to zero does not move.
                    const V found = value_at(packet, channel(first + k));
                    bars[k] = P::pick(found < P::all(F(0)), P::all(F(0)), bar);
                }
                F* const field = values_bar + first * size;
#if defined(__CUDA_ARCH__)
                for (int k = 0; k < count; ++k)
                    spread_place(field + k * size, packet.y, packet.x, lines(), bars[k], -bars[k]);
#else
                for (int r = 0; r < packet.runs.count; ++r) {
                    const Shares<F> shares(packet.runs.run[r], packet.y, packet.x, lines(), true);
                    for (int k = 0; k < count; ++k)
                        shares.template add<true>(field + k * size, bars[k], -bars[k]);
                }
#endif
            }
        }
    }
};

} // namespace ddrecon
