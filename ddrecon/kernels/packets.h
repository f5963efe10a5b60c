#pragma once
#include "ddrecon/kernels/numbers.h"
// Many alike items at a time: a packet of LANES runs in a processor's vector lanes. Where
// neighboring items need values from places of their own (rays that walk through cells), a loop
// over numbers beside each other does not do. Then every value is a vector of LANES numbers, one of
// each item, and the code reads as that for a single item does: `a * b`, `pick(a < b, a, b)`. On a
// GPU a packet is one item, its values are plain numbers, and a thread does it.

namespace ddrecon {

#if IS_GPU
constexpr int LANES = 1;
#else
constexpr int LANES = 16;
// Packets are no part of an interface between compilers, which is what is warned of.
#pragma GCC diagnostic ignored "-Wpsabi"
constexpr unsigned ALL_LANES = (1u << LANES) - 1;
#endif

// V are numbers of type F, I whole numbers, W numbers in double precision; M and IM are what
// comparisons of V and of I give.
template <class F> struct Packets {
    typedef Format<F> Own;
#if IS_GPU
    typedef F V;
    typedef int I;
    typedef double W;
    typedef bool M;
    typedef bool IM;
#else
    typedef F V __attribute__((vector_size(LANES * sizeof(F))));
    typedef int I __attribute__((vector_size(LANES * sizeof(int))));
    typedef double W __attribute__((vector_size(LANES * sizeof(double))));
    typedef decltype(V{} < V{}) M;
    typedef I IM;
    typedef bool Bits __attribute__((ext_vector_type(LANES)));
#endif
    static INLINE V all(F x) { return x - V{}; }
    static INLINE V pick(M is, V a, V b) { return is ? a : b; }
    static INLINE I pick(IM is, I a, I b) { return is ? a : b; }
    static INLINE V least(V a, V b) { return a < b ? a : b; }
    static INLINE V most(V a, V b) { return a > b ? a : b; }
#if IS_GPU
    static INLINE I whole(V x) { return (int)x; }
    static INLINE V real(I x) { return F(x); }
    static INLINE W wide(V x) { return (double)x; }
    static INLINE V narrow(W x) { return F(x); }
    static INLINE V root(V x) { return sqrt(x); }
    static INLINE V size(V x) { return x < F(0) ? -x : x; }
    static INLINE bool every(M is) { return is; }
    static INLINE F lane(V x, int) { return x; }
    static INLINE double lane_of(W x, int) { return x; }
    static INLINE int lane_of(I x, int) { return x; }
    static INLINE W load_wide(const double* p, int first, int) { return p[first]; }
    static INLINE void put(V& x, int, F value) { x = value; }
    static INLINE V read(const F* p) { return *p; }
    static INLINE void write(F* p, V x) { *p = x; }
    static INLINE V gather(const F* p, I at) { return p[at]; }
    static INLINE V log(V x) { return ::log(x); }
    static INLINE V decay(V depth) { return ddrecon::decay(depth); }
#else
    static INLINE I whole(V x) { return __builtin_convertvector(x, I); }
    static INLINE V real(I x) { return __builtin_convertvector(x, V); }
    static INLINE W wide(V x) { return __builtin_convertvector(x, W); }
    static INLINE V narrow(W x) { return __builtin_convertvector(x, V); }
    static INLINE V root(V x) { return __builtin_elementwise_sqrt(x); }
    static INLINE V size(V x) { return __builtin_elementwise_abs(x); }
    static INLINE bool every(M is) { return __builtin_reduce_and(is) != 0; }
    // Lanes in a mask as bits of a number, of which the first is the lowest; and back.
    static INLINE unsigned bits_of(IM is) {
        return __builtin_bit_cast(unsigned short, __builtin_convertvector(is, Bits));
    }
    static INLINE IM lanes_of(unsigned bits) { return ((I{} + (int)bits) >> numbers() & 1) != 0; }
    static INLINE I numbers() {
        I x;
        for (int l = 0; l < LANES; ++l) x[l] = l;
        return x;
    }
    static INLINE F lane(V x, int l) { return x[l]; }
    static INLINE double lane_of(W x, int l) { return x[l]; }
    static INLINE int lane_of(I x, int l) { return x[l]; }
    static INLINE W load_wide(const double* p, int first, int last) {
        W x;
        for (int l = 0; l < LANES; ++l) x[l] = p[first + l < last ? first + l : last];
        return x;
    }
    static INLINE void put(V& x, int l, F value) { x[l] = value; }
    // LANES numbers beside each other.
    static INLINE V read(const F* p) {
        V x;
        __builtin_memcpy(&x, p, sizeof(V));
        return x;
    }
    static INLINE void write(F* p, V x) { __builtin_memcpy(p, &x, sizeof(V)); }
    static INLINE V gather(const F* p, I at) {
        V x;
        for (int l = 0; l < LANES; ++l) x[l] = p[at[l]];
        return x;
    }
    static INLINE V decay(V depth) { return decay_of<F, M>(depth); }
    // log x = n log 2 + log m with x = 2^n m > 0 and m between the root of 1/2 and that of 2:
    // log m = 2 (s + s^3 / 3 + s^5 / 5 + ...), where s = (m - 1) / (m + 1).
    static INLINE V log(V x) {
        const M bits = __builtin_bit_cast(M, x), n = (bits - Own::root_bits) >> Own::digits;
        const V m = __builtin_bit_cast(V, bits - (n << Own::digits));
        const V s = (m - F(1)) / (m + F(1));
        const V p = series<of_log, F, Own::log_terms>(s * s);
        return F(2) * s * p + __builtin_convertvector(n, V) * F(0.69314718055994530942);
    }
#endif
    // The lanes' sum, in double precision.
    static INLINE double sum(V x) {
        double total = 0.0;
        for (int l = 0; l < LANES; ++l) total += (double)lane(x, l);
        return total;
    }
    // Entries first, first + step, ... of p; `last` stands for those beyond it.
    static INLINE V load(const F* p, int first, int step, int last) {
        V x = all(F(0));
        for (int l = 0; l < LANES; ++l)
            put(x, l, p[(long long)(first + l < last ? first + l : last) * step]);
        return x;
    }
    // psi of depths from 0 to 1/2.
    static INLINE V psi_series(V depth) { return series<of_psi, F, Own::terms>(-depth); }
};

} // namespace ddrecon
