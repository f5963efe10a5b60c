#pragma once
// What kernels compute with: numbers F, float or double, and functions of a depth that become
// vector code. Included at namespace scope by Warp, for processors and for GPUs.

// Whether an item is one cell, ray or light way, which a thread of a GPU does. DDRECON_AS_ON_A_GPU
// has a processor do the same, for tests: items then come one after another, in any order.
#if defined(__CUDA_ARCH__) || defined(DDRECON_AS_ON_A_GPU)
#define IS_GPU 1
#else
#define IS_GPU 0
#endif
#if defined(__CUDA_ARCH__)
#define INLINE __device__ __forceinline__
#define HERE
#else
#define INLINE inline __attribute__((always_inline))
// The same of a lambda.
#define HERE __attribute__((always_inline))
#endif
#if defined(__clang__)
// Products are added in one instruction where the processor has one (on a GPU that is the rule).
#pragma clang fp contract(fast)
// First in a block: its sums have a free order, or else they would not become vector code.
#define REORDERED _Pragma("clang fp reassociate(on)")
// Before a loop over constants, whose arrays become registers before anything else is optimized.
#define UNROLLED _Pragma("clang loop unroll(full)")
#else
#define REORDERED
#define UNROLLED _Pragma("unroll")
#endif
#if defined(__clang__) && !defined(__CUDA_ARCH__)
// Before a loop: no turn reads what another writes, which clang cannot see of many arrays.
#define INDEPENDENT _Pragma("clang loop vectorize(assume_safety)")
// The same where the loop has sums, of which several turns at once need more numbers than registers
// hold.
#define SUMMING \
    INDEPENDENT \
    _Pragma("clang loop interleave_count(1)")
#else
#define INDEPENDENT
#define SUMMING
#endif

namespace ddrecon {

// Numbers to which many items add. Threads of a GPU do so in any order and come to the same bits:
// they add whole numbers, shares times a scale by which a bound that no sum exceeds is 2^62.
#if IS_GPU
template <class F> using Sum = long long;
#else
template <class F> using Sum = F;
#endif
template <class F> INLINE void add_to(Sum<F>* sum, F share) {
#if defined(__CUDA_ARCH__)
    atomicAdd((unsigned long long*)sum, (unsigned long long)(long long)share);
#else
    *sum += (Sum<F>)share;
#endif
}
template <class F> INLINE F scale_of(double bound) {
    // What is no number stays so, and that of float does not overflow.
    return F(0x1p62 / (bound < 0x1p-60 ? 0x1p-60 : bound));
}

// How numbers are written, and log(2) in two parts, for `decay`; how many terms of series count.
template <class F> struct Format;
template <> struct Format<float> {
    typedef int Bits;
    static constexpr int digits = 23, terms = 8, log_terms = 6, root_bits = 0x3f3504f3;
    static constexpr float most = 87.0f, shift = 12582912.0f;
    static constexpr float log2_high = 0.693145751953125f, log2_low = 1.42860682030941723212e-6f;
};
template <> struct Format<double> {
    typedef long long Bits;
    static constexpr int digits = 52, terms = 14, log_terms = 11;
    static constexpr long long root_bits = 0x3fe6a09e667f3bcd;
    static constexpr double most = 700.0, shift = 6755399441055744.0;
    static constexpr double log2_high = 0.693147180369123816490;
    static constexpr double log2_low = 1.90821492927058770002e-10;
};

// How little before a cell's center a place counts as on it, in units of a line's length
// (`numerics/interpolation.py`).
template <class F> constexpr F NEARLY = F(16 * (sizeof(F) == 8 ? 0x1p-52 : 0x1p-23));

constexpr INLINE double factorial(int n) {
    double product = 1.0;
    for (int k = 2; k <= n; ++k) product *= k;
    return product;
}
// Coefficients of exp(x), of psi(-x), of eta(-x), of its slope eta'(-x), and of
// log((1 + s) / (1 - s)) / (2 s) in s^2.
constexpr INLINE double of_exp(int k) { return 1 / factorial(k); }
constexpr INLINE double of_psi(int k) { return 1 / factorial(k + 2); }
constexpr INLINE double of_eta(int k) { return (k + 1) / (2 * factorial(k + 3)); }
constexpr INLINE double of_eta_slope(int k) { return -(k + 1) * (k + 2) / (2 * factorial(k + 4)); }
constexpr INLINE double of_log(int k) { return 1.0 / (2 * k + 1); }

// TERMS of a series at x, a number or a vector of them, by Horner's rule.
template <double (&COEFFICIENT)(int), class F, int TERMS, int K = 0, class N> INLINE N series(N x) {
    constexpr F coefficient = F(COEFFICIENT(K));
    if constexpr (K + 1 == TERMS) {
        return N{} + coefficient;
    } else {
        return series<COEFFICIENT, F, TERMS, K + 1>(x) * x + coefficient;
    }
}

// exp(-depth) = 2^n e^r with n whole and |r| < log(2) / 2. Adding and taking away `shift` rounds to
// a whole number, whose digits are then those at the end of the sum. libm's exp is no vector code.
// For depths from about -87 to any size, exact to the last digit but one; where it is below about
// 1e-38 (1e-304 of doubles) it is that. What is not a number stays so. N are numbers F or vectors
// of them, Bits the same of whole numbers.
template <class F, class Bits, class N> INLINE N decay_of(N depth) {
#if defined(__CUDA_ARCH__)
    return exp(-depth);
#else
    typedef Format<F> Own;
    const N end = Own::most - N{}, x = depth > end ? -end : (depth < -end ? end : -depth);
    const N shifted = x * F(1.4426950408889634074) + Own::shift, n = shifted - Own::shift;
    const N r = (x - n * Own::log2_high) - n * Own::log2_low;
    const Bits p = __builtin_bit_cast(Bits, series<of_exp, F, Own::terms>(r));
    return __builtin_bit_cast(N, p + (__builtin_bit_cast(Bits, shifted) << Own::digits));
#endif
}
template <class F> INLINE F decay(F depth) { return decay_of<F, typename Format<F>::Bits>(depth); }

// The square root of a number that is at least 0: libm's, which tells of others, is no vector code.
template <class F> INLINE F root(F x) {
#if defined(__CUDA_ARCH__)
    return sqrt(x);
#else
    return __builtin_elementwise_sqrt(x);
#endif
}

// psi, eta (`numerics/decay.py`) and its derivative, for depths from 0 to 1/2; that of psi is -2
// eta.
template <class F> INLINE F psi_series(F depth) {
    return series<of_psi, F, Format<F>::terms>(-depth);
}
template <class F> INLINE F eta_series(F depth) {
    return series<of_eta, F, Format<F>::terms>(-depth);
}
template <class F> INLINE F eta_slope_series(F depth) {
    return series<of_eta_slope, F, Format<F>::terms>(-depth);
}

// phi, psi and eta (`numerics/decay.py`) of a depth of at least 0, of which `kept` is the decay;
// by series where it `is_thin`, below 1/2.
template <class F> struct Decayed {
    F phi, psi, eta;
};
template <class F> INLINE Decayed<F> decayed(F depth, F kept, bool is_thin) {
    const F thin = is_thin ? depth : F(0), inverse = F(1) / (is_thin ? F(0.5) : depth);
    const F near_psi = psi_series(thin), near_eta = eta_series(thin);
    const F phi = is_thin ? F(1) - depth * near_psi : (F(1) - kept) * inverse;
    const F psi = is_thin ? near_psi : (F(1) - phi) * inverse;
    return {phi, psi, is_thin ? near_eta : (psi - F(0.5) * phi) * inverse};
}
template <class F> INLINE Decayed<F> decayed(F depth) {
    return decayed(depth, decay(depth), depth < F(0.5));
}

// A sum in double precision, eight at a time.
template <class F> INLINE double total(const F* values, int count) {
    double lanes[8] = {0, 0, 0, 0, 0, 0, 0, 0}, sum = 0;
    int t = 0;
    for (; t + 8 <= count; t += 8)
        for (int i = 0; i < 8; ++i) lanes[i] += (double)values[t + i];
    for (; t < count; ++t) sum += (double)values[t];
    for (int i = 0; i < 8; ++i) sum += lanes[i];
    return sum;
}

} // namespace ddrecon
