"""C++ for kernels whose items are many alike: a packet of them runs in a processor's vector lanes.

Where neighboring items need values from places of their own (rays that walk through cells), a loop
over numbers beside each other does not do. Then every value is a vector `V` of LANES numbers, one
of each item, and the text reads as that for a single item does: `a * b`, `pick(a < b, a, b)`. On a
GPU a packet is one item, `V` a plain number, and a thread does it.

    text = "V y = P::load(x, item * LANES, 1, last); ..."
    TextKernel(name, bits, text, "F *x, *z", "z", packet_program)

`V` are numbers of type `F`, `I` whole numbers, `W` numbers in double precision; `P` has the
functions below.
"""

from __future__ import annotations

import functools

from ddrecon.kernels.native import names, taylor

LANES = 16
"""Items in a packet on a processor."""

_TEXT = """
typedef {number} F;
#if defined(__CUDA_ARCH__)
typedef F V;
typedef int I;
typedef double W;
typedef bool M;
typedef bool IM;
constexpr int LANES = 1;
#define INLINE static __device__ __forceinline__
#else
constexpr int LANES = {lanes};
constexpr unsigned ALL_LANES = (1u << LANES) - 1;
typedef F V __attribute__((vector_size(LANES * sizeof(F))));
typedef int I __attribute__((vector_size(LANES * sizeof(int))));
typedef double W __attribute__((vector_size(LANES * sizeof(double))));
typedef decltype(V{{}} < V{{}}) M;
typedef I IM;
typedef bool Bits __attribute__((ext_vector_type(LANES)));
#define INLINE static inline __attribute__((always_inline))
#endif
struct P {{
    INLINE V pick(M is, V one, V other) {{ return is ? one : other; }}
    INLINE I pick(IM is, I one, I other) {{ return is ? one : other; }}
    INLINE V least(V a, V b) {{ return a < b ? a : b; }}
    INLINE V most(V a, V b) {{ return a > b ? a : b; }}
#if defined(__CUDA_ARCH__)
    INLINE V all(F x) {{ return x; }}
    INLINE I whole(V x) {{ return (int)x; }}
    INLINE V real(I x) {{ return F(x); }}
    INLINE W wide(V x) {{ return (double)x; }}
    INLINE V narrow(W x) {{ return F(x); }}
    INLINE V root(V x) {{ return sqrt(x); }}
    INLINE V inverse_root(V x) {{ return F(1) / sqrt(x); }}
    INLINE V size(V x) {{ return x < F(0) ? -x : x; }}
    INLINE bool every(M is) {{ return is; }}
    INLINE F lane(V x, int) {{ return x; }}
    INLINE double lane_of(W x, int) {{ return x; }}
    INLINE int lane_of(I x, int) {{ return x; }}
    INLINE W load_wide(const double* p, int first, int) {{ return p[first]; }}
    INLINE void put(V& x, int, F value) {{ x = value; }}
    INLINE V read(const F* p) {{ return *p; }}
    INLINE void write(F* p, V x) {{ *p = x; }}
    INLINE V gather(const F* p, I at) {{ return p[at]; }}
    INLINE void add(F* p, I at, V x) {{ atomicAdd(p + at, x); }}
    INLINE V decay(V depth) {{ return {exp}(-depth); }}
    INLINE V log(V x) {{ return ::log(x); }}
    INLINE void add_one(F* p, F x) {{ atomicAdd(p, x); }}
#else
    INLINE V all(F x) {{ return x - V{{}}; }}
    INLINE I whole(V x) {{ return __builtin_convertvector(x, I); }}
    INLINE V real(I x) {{ return __builtin_convertvector(x, V); }}
    INLINE W wide(V x) {{ return __builtin_convertvector(x, W); }}
    INLINE V narrow(W x) {{ return __builtin_convertvector(x, V); }}
    INLINE V root(V x) {{ return __builtin_elementwise_sqrt(x); }}
    // 1 / root of x; by a step of Newton's from 14 bits where the processor has these.
    INLINE V inverse_root(V x) {{
#if defined(__AVX512F__)
        if (sizeof(V) == 64 && sizeof(F) == 4) {{
            typedef float V32 __attribute__((vector_size(64)));
            V32 known;
            __builtin_memcpy(&known, &x, sizeof(V32));
            known = __builtin_ia32_rsqrt14ps512_mask(known, known, (unsigned short)-1);
            V r;
            __builtin_memcpy(&r, &known, sizeof(V));
            return r * (F(1.5) - F(0.5) * x * r * r);
        }}
#endif
        return F(1) / root(x);
    }}
    INLINE V size(V x) {{ return __builtin_elementwise_abs(x); }}
    INLINE bool every(M is) {{ return __builtin_reduce_and(is) != 0; }}
    // Lanes in a mask as bits of a number, of which the first is the lowest; and back.
    INLINE unsigned bits_of(IM is) {{
        return __builtin_bit_cast(unsigned short, __builtin_convertvector(is, Bits));
    }}
    INLINE IM lanes_of(unsigned bits) {{
        return ((I{{}} + (int)bits) >> numbers() & 1) != 0;
    }}
    INLINE I numbers() {{
        I x;
        for (int l = 0; l < LANES; ++l) x[l] = l;
        return x;
    }}
    INLINE F lane(V x, int l) {{ return x[l]; }}
    INLINE double lane_of(W x, int l) {{ return x[l]; }}
    INLINE int lane_of(I x, int l) {{ return x[l]; }}
    INLINE W load_wide(const double* p, int first, int last) {{
        W x;
        for (int l = 0; l < LANES; ++l) x[l] = p[first + l < last ? first + l : last];
        return x;
    }}
    INLINE void put(V& x, int l, F value) {{ x[l] = value; }}
    // LANES numbers beside each other.
    INLINE V read(const F* p) {{
        V x;
        __builtin_memcpy(&x, p, sizeof(V));
        return x;
    }}
    INLINE void write(F* p, V x) {{ __builtin_memcpy(p, &x, sizeof(V)); }}
    INLINE V gather(const F* p, I at) {{
        V x;
        for (int l = 0; l < LANES; ++l) x[l] = p[at[l]];
        return x;
    }}
    INLINE void add(F* p, I at, V x) {{
        for (int l = 0; l < LANES; ++l) p[at[l]] += x[l];
    }}
    INLINE void add_one(F* p, F x) {{ *p += x; }}
    // log x = n log 2 + log m with x = 2^n m > 0 and m between the root of 1/2 and that of 2:
    // log m = 2 (s + s^3 / 3 + s^5 / 5 + ...), where s = (m - 1) / (m + 1).
    INLINE V log(V x) {{
        const M bits = __builtin_bit_cast(M, x), n = (bits - ({integer}){root_bits}) >> {digits};
        const V m = __builtin_bit_cast(V, bits - (n << {digits}));
        const V s = (m - F(1)) / (m + F(1)), square = s * s;
        V p = all(F({odd_first}));
        {odd}
        return F(2) * s * p + __builtin_convertvector(n, V) * F(0.69314718055994530942);
    }}
    // exp(-depth) = 2^n e^r with n whole and |r| < log(2) / 2, as in `native`.
    INLINE V decay(V depth) {{
        const V end = all(F({most}));
        // What is not a number stays so.
        const V x = pick(depth > end, -end, pick(depth < -end, end, -depth));
        const V shifted = x * F(1.4426950408889634074) + F({shift});
        const V n = shifted - F({shift});
        const V r = (x - n * F({log2_high})) - n * F({log2_low});
        V p = all(F({first}));
        {horner}
        return __builtin_bit_cast(
            V, __builtin_bit_cast(M, p) + (__builtin_bit_cast(M, shifted) << {digits}));
    }}
#endif
    // The lanes' sum, in double precision.
    INLINE double sum(V x) {{
        double total = 0.0;
        for (int l = 0; l < LANES; ++l) total += (double)lane(x, l);
        return total;
    }}
    // Entries first, first + step, ... of p; `last` stands for those beyond it.
    INLINE V load(const F* p, int first, int step, int last) {{
        V x = all(F(0));
        for (int l = 0; l < LANES; ++l)
            put(x, l, p[(long long)(first + l < last ? first + l : last) * step]);
        return x;
    }}
    // (1 - phi(depth)) / depth of depths from 0 to 1/2, where phi = (1 - exp(-depth)) / depth.
    INLINE V psi_series(V depth) {{
        V p = all(F({psi_first}));
        {psi}
        return p;
    }}
}};
"""


@functools.cache
def _definitions(bits: int) -> str:
    psi_first, psi = taylor(bits, 2, -1, "depth")
    odd = [1 / (2 * k + 1) for k in range(11 if bits == 64 else 6)]
    series = {
        "psi_first": psi_first,
        "psi": psi,
        "odd_first": odd[-1],
        "odd": " ".join(f"p = p * square + F({each!r});" for each in reversed(odd[:-1])),
    }
    return _TEXT.format(**names(bits), **series, lanes=LANES)


def packet_program(bits: int, body: str) -> str:
    """C++ of `body` behind the types and functions of packets."""
    return _definitions(bits) + body
