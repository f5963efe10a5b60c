#pragma once
#include "ddrecon/transport/fused/step.h"
// Numbers of a row of cells.

namespace ddrecon {

// Where they lie: of dual numbers, values and changes.
template <class N> struct Line {
    N* at;
    INLINE N operator[](long long c) const { return at[c]; }
    INLINE void put(long long c, const N& x) const { at[c] = x; }
    INLINE Line operator+(long long by) const { return {at + by}; }
};
template <class F> struct Line<Dual<F>> {
    F *at, *change;
    INLINE Dual<F> operator[](long long c) const { return Dual<F>(at[c], change[c]); }
    INLINE void put(long long c, const Dual<F>& x) const { at[c] = x.value, change[c] = x.by[0]; }
    INLINE Line operator+(long long by) const { return {at + by, change + by}; }
};
// A line whose changes lie so much behind its values.
template <class N, class F> INLINE Line<N> line_at(const F* at, long long behind) {
    if constexpr (sizeof(N) == sizeof(F))
        return {(F*)at};
    else
        return {(F*)at, (F*)at + behind};
}

// What reaches cell c from those where its step begins.
template <int POINTS, class N, class F>
INLINE N gather(const Line<N>* from, const F* part, long long c) {
    if constexpr (POINTS == 1)
        return from[0][c];
    else
        return part[0] * from[0][c] + part[1] * from[1][c] + part[2] * from[2][c] +
               part[3] * from[3][c];
}

template <class F> struct Vectors {
    static constexpr int LANES = 64 / sizeof(F);
    typedef F V __attribute__((vector_size(64)));
};
template <class T, class F> INLINE T read(const F* p) {
    T x;
    __builtin_memcpy(&x, p, sizeof(T));
    return x;
}
template <class T, class F> INLINE void write(F* p, const T& x) {
    __builtin_memcpy(p, &x, sizeof(T));
}
// Cells `from` to `to`: vectors of them, then single ones, of which `step` is given a value.
template <class F, class Step> INLINE void in_steps(int from, int to, Step step) {
    typedef Vectors<F> Own;
    int c = from;
    for (; c + Own::LANES <= to; c += Own::LANES) step(typename Own::V{}, c);
    for (; c < to; ++c) step(F(0), c);
}

template <class T, T... I> struct Places {};
// x and what it is multiplied by, moved by so many lanes.
template <int BY, class F, class V, int... I> INLINE void shift(V& x, V& p, Places<int, I...>) {
    constexpr int LANES = sizeof...(I);
    const V none{}, one = none + F(1);
    x += p * __builtin_shufflevector(x, none, (I >= BY && I < LANES + BY ? I - BY : LANES + I)...);
    p *= __builtin_shufflevector(p, one, (I >= BY && I < LANES + BY ? I - BY : LANES + I)...);
}
template <int WAY, class F> INLINE auto scan(const F* values, const F* passed, F before) {
    typedef typename Vectors<F>::V V;
    typedef __make_integer_seq<Places, int, Vectors<F>::LANES> All;
    V x = read<V>(values), p = read<V>(passed);
    shift<WAY, F>(x, p, All());
    shift<2 * WAY, F>(x, p, All());
    shift<4 * WAY, F>(x, p, All());
    if constexpr (sizeof(F) == 4) shift<8 * WAY, F>(x, p, All());
    return x + p * before;
}
// What comes along a row is carried on from cell to cell, x_c + passed_c x_(c - way) in place: over
// a vector in steps of 1, 2, 4 ... cells.
template <class F>
__attribute__((noinline)) void carry_on(F* values, const F* passed, int way, int width) {
    typedef typename Vectors<F>::V V;
    constexpr int LANES = Vectors<F>::LANES;
    const int whole = width / LANES * LANES;
    F last = F(0);
    auto step = [&](int c) { last = values[c] = values[c] + passed[c] * last; };
    if (way > 0) {
        for (int c = 0; c < whole; c += LANES) {
            const V found = scan<1>(values + c, passed + c, last);
            write(values + c, found);
            last = found[LANES - 1];
        }
        for (int c = whole; c < width; ++c) step(c);
    } else {
        for (int c = width - 1; c >= whole; --c) step(c);
        for (int c = whole - LANES; c >= 0; c -= LANES) {
            const V found = scan<-1>(values + c, passed + c, last);
            write(values + c, found);
            last = found[0];
        }
    }
}

} // namespace ddrecon
