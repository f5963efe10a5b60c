#pragma once
#include "ddrecon/kernels/dual.h"
#include "ddrecon/kernels/packets.h"
// Functions of a packet's numbers N: vectors V, or dual numbers of these.

namespace ddrecon {

template <bool IS, class A, class B> struct Either {
    typedef A type;
};
template <class A, class B> struct Either<false, A, B> {
    typedef B type;
};

template <class F> struct Numbers : Packets<F> {
    typedef Packets<F> P;
    typedef typename P::V V;
    typedef typename P::M M;
    template <int K> using D = Dual<V, K>;
    using P::least, P::log, P::most, P::narrow, P::pick, P::root, P::wide;

    template <int K> static INLINE D<K> pick(M is, const D<K>& one, const D<K>& other) {
        D<K> r;
        r.value = pick(is, one.value, other.value);
        UNROLLED
        for (int k = 0; k < K; ++k) r.by[k] = pick(is, one.by[k], other.by[k]);
        return r;
    }
    template <int K> static INLINE D<K> least(const D<K>& a, const D<K>& b) {
        return pick(a.value < b.value, a, b);
    }
    template <int K> static INLINE D<K> most(const D<K>& a, const D<K>& b) {
        return pick(a.value > b.value, a, b);
    }
    template <int K> static INLINE D<K> root(const D<K>& x) {
        const V found = root(x.value);
        return x.chain(found, F(0.5) / found);
    }
    template <int K> static INLINE D<K> log(const D<K>& x) {
        return x.chain(log(x.value), F(1) / x.value);
    }
    // In double precision, and back.
    static INLINE Dual<typename P::W> wide(const D<1>& x) { return {wide(x.value), wide(x.by[0])}; }
    static INLINE D<1> narrow(const Dual<typename P::W>& x) {
        return {narrow(x.value), narrow(x.by[0])};
    }
    static INLINE V atan2(V y, V x) {
        V angle = P::all(F(0));
        for (int l = 0; l < LANES; ++l) P::put(angle, l, wp::atan2(P::lane(y, l), P::lane(x, l)));
        return angle;
    }
    template <int K> static INLINE D<K> atan2(const D<K>& y, const D<K>& x) {
        const V inverse = F(1) / (y.value * y.value + x.value * x.value);
        return y.chain(atan2(y.value, x.value), x.value * inverse, x, -y.value * inverse);
    }
    // Lane l, of many in memory: where l is no constant.
    static INLINE F own(const V& x, int l) { return ((const F*)&x)[l]; }
    // A dual number's value, or its change.
    template <int PART, class X> static INLINE X& part(X& x) { return x; }
    template <int PART, class X> static INLINE X& part(Dual<X>& x) {
        return PART ? x.by[0] : x.value;
    }
};

} // namespace ddrecon
