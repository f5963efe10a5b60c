#pragma once
#include "ddrecon/kernels/numbers.h"
// Forward mode: a number and its derivatives along COUNT directions. A function written for any
// number N, called with Dual<F>, has its tangent beside its value; with as many directions as it is
// given numbers, it has all its slopes.

namespace ddrecon {

// A function of one number: its value and its slope there.
template <class F> struct Sloped {
    F value, slope;
};

template <class F, int COUNT = 1> struct Dual {
    F value, by[COUNT];
    INLINE Dual() {}
    INLINE Dual(F value) : value(value) {
        UNROLLED
        for (int k = 0; k < COUNT; ++k) by[k] = F{};
    }
    INLINE Dual(F value, F change) : value(value) {
        static_assert(COUNT == 1, "one change is for one direction");
        by[0] = change;
    }
    // Copied by hand: compilers then keep numbers, where they would make short vectors of them, and
    // loops of short vectors do not become loops of long ones.
    INLINE Dual(const Dual& o) { *this = o; }
    INLINE Dual& operator=(const Dual& o) {
        value = o.value;
        UNROLLED
        for (int k = 0; k < COUNT; ++k) by[k] = o.by[k];
        return *this;
    }
    // A function's `value`, from its slopes by this number and by another one.
    INLINE Dual chain(F value, F by_this) const {
        Dual r;
        r.value = value;
        UNROLLED
        for (int k = 0; k < COUNT; ++k) r.by[k] = by_this * by[k];
        return r;
    }
    INLINE Dual chain(F value, F by_this, const Dual& o, F by_other) const {
        Dual r;
        r.value = value;
        UNROLLED
        for (int k = 0; k < COUNT; ++k) r.by[k] = by_this * by[k] + by_other * o.by[k];
        return r;
    }
    // 1, of vectors in all lanes.
    static INLINE F one() { return 1 - F{}; }
    INLINE Dual operator-() const { return chain(-value, -one()); }
    INLINE Dual operator+(const Dual& o) const { return chain(value + o.value, one(), o, one()); }
    INLINE Dual operator-(const Dual& o) const { return chain(value - o.value, one(), o, -one()); }
    INLINE Dual operator*(const Dual& o) const { return chain(value * o.value, o.value, o, value); }
    INLINE Dual operator/(const Dual& o) const {
        const F inverse = 1 / o.value, quotient = value * inverse;
        return chain(quotient, inverse, o, -quotient * inverse);
    }
    INLINE Dual& operator+=(const Dual& o) { return *this = *this + o; }
    INLINE Dual& operator-=(const Dual& o) { return *this = *this - o; }
};
// With plain numbers on either side, which of vectors may be one for all lanes.
template <class A, class F, int COUNT> INLINE Dual<F, COUNT> operator+(A a, Dual<F, COUNT> b) {
    b.value = a + b.value;
    return b;
}
// A copy that changes: of a sum the other way around, loops do not become vector code.
template <class A, class F, int COUNT> INLINE Dual<F, COUNT> operator+(Dual<F, COUNT> a, A b) {
    a.value = a.value + b;
    return a;
}
template <class A, class F, int COUNT>
INLINE Dual<F, COUNT> operator-(A a, const Dual<F, COUNT>& b) {
    return a + -b;
}
template <class A, class F, int COUNT> INLINE Dual<F, COUNT> operator-(Dual<F, COUNT> a, A b) {
    a.value = a.value - b;
    return a;
}
template <class A, class F, int COUNT>
INLINE Dual<F, COUNT> operator*(A a, const Dual<F, COUNT>& b) {
    return b.chain(a * b.value, a - F{});
}
template <class A, class F, int COUNT>
INLINE Dual<F, COUNT> operator*(const Dual<F, COUNT>& a, A b) {
    return b * a;
}
template <class A, class F, int COUNT>
INLINE Dual<F, COUNT> operator/(A a, const Dual<F, COUNT>& b) {
    const F inverse = 1 / b.value, quotient = a * inverse;
    return b.chain(quotient, -quotient * inverse);
}
template <class A, class F, int COUNT>
INLINE Dual<F, COUNT> operator/(const Dual<F, COUNT>& a, A b) {
    return a * (1 / (b - F{}));
}

// The value of a number of either kind, for comparisons; and a choice by one.
template <class F> INLINE F value_of(F x) { return x; }
template <class F, int COUNT> INLINE F value_of(const Dual<F, COUNT>& x) { return x.value; }
template <class N> INLINE N pick(bool is, const N& a, const N& b) { return is ? a : b; }
template <class F, int COUNT>
INLINE Dual<F, COUNT> pick(bool is, const Dual<F, COUNT>& a, const Dual<F, COUNT>& b) {
    Dual<F, COUNT> r;
    r.value = is ? a.value : b.value;
    UNROLLED
    for (int k = 0; k < COUNT; ++k) r.by[k] = is ? a.by[k] : b.by[k];
    return r;
}

// The root of a number > 0, or 0, where the slope counts as 0.
template <class F, int COUNT> INLINE Dual<F, COUNT> root(const Dual<F, COUNT>& x) {
    const F value = root(x.value);
    return x.chain(value, value > F(0) ? F(0.5) / value : F(0));
}

// Arrays of values and of their changes, which are read as dual numbers.
template <class F> struct Changing {
    const F *value, *change;
    INLINE Dual<F> operator[](long long i) const { return {value[i], change[i]}; }
    INLINE Changing operator+(long long i) const { return {value + i, change + i}; }
};
// What is written of a number: itself, or of a dual number its change.
template <class F> INLINE F change_of(F x) { return x; }
template <class F> INLINE F change_of(const Dual<F>& x) { return x.by[0]; }

// One type or another.
template <bool IS, class A, class B> struct If {
    typedef A type;
};
template <class A, class B> struct If<false, A, B> {
    typedef B type;
};

// Whether numbers N have derivatives.
template <class N> constexpr bool IS_DUAL = false;
template <class F, int COUNT> constexpr bool IS_DUAL<Dual<F, COUNT>> = true;

// What numbers N are read from: arrays of values and, where N are dual, of their changes.
template <class N, class F> INLINE auto readable(const F* value, const F* change) {
    if constexpr (IS_DUAL<N>)
        return Changing<F>{value, change};
    else
        return value;
}

// A function `f` of one number, known at the value of `x`, as a function of x itself.
template <class F> INLINE F along(F, const Sloped<F>& f) { return f.value; }
template <class F, int COUNT>
INLINE Dual<F, COUNT> along(const Dual<F, COUNT>& x, const Sloped<F>& f) {
    return x.chain(f.value, f.slope);
}

} // namespace ddrecon
