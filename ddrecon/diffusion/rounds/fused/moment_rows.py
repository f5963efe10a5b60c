"""Rows of moments from rows of radiance along directions, and the other way around, in C++ (E17).

Products of small matrices with rows: out_i = sum_j matrix_ij in_j, from one cell to another. A
direction and its mirror image in x, a pair, share sums over moments even and odd in x.
"""

MULTIPLY = """
struct Six { enum { value = 6 }; };
struct Ten { enum { value = 10 }; };
typedef F V __attribute__((vector_size(64), aligned(sizeof(F))));
const int LANES = 64 / sizeof(F);
auto multiply_block = [&](auto tall, auto wide, const F* matrix, int ins, F* const* out,
                          const F* const* in, int c) {
    constexpr int R = decltype(tall)::value, N = decltype(wide)::value;
    V sum[R][N];
#pragma clang loop unroll(full)
    for (int a = 0; a < R; ++a)
#pragma clang loop unroll(full)
        for (int b = 0; b < N; ++b)
            sum[a][b] = V{};
    for (int j = 0; j < ins; ++j) {
        const F* from = in[j] + c;
#pragma clang loop unroll(full)
        for (int a = 0; a < R; ++a)
#pragma clang loop unroll(full)
            for (int b = 0; b < N; ++b)
                sum[a][b] += matrix[a * ins + j] * *(const V*)(from + b * LANES);
    }
#pragma clang loop unroll(full)
    for (int a = 0; a < R; ++a)
#pragma clang loop unroll(full)
        for (int b = 0; b < N; ++b) *(V*)(out[a] + c + b * LANES) = sum[a][b];
};
auto multiply_rows = [&](auto tall, const F* matrix, int ins, F* const* out, const F* const* in,
                         int from, int to) {
    int c = from;
    for (; c + 4 * LANES <= to; c += 4 * LANES)
        multiply_block(tall, Four(), matrix, ins, out, in, c);
    for (; c + LANES <= to; c += LANES)
        multiply_block(tall, One(), matrix, ins, out, in, c);
    for (; c < to; ++c)
        for (int a = 0; a < decltype(tall)::value; ++a) {
            F sum = F(0);
            for (int j = 0; j < ins; ++j) sum += matrix[a * ins + j] * in[j][c];
            out[a][c] = sum;
        }
};
auto multiply = [&](const F* matrix, int outs, int ins, F* const* out, const F* const* in,
                    int from, int to) __attribute__((noinline)) {
    int i = 0;
    for (; i + 4 <= outs; i += 4)
        multiply_rows(Four(), matrix + i * ins, ins, out + i, in, from, to);
    for (; i + 2 <= outs; i += 2)
        multiply_rows(Two(), matrix + i * ins, ins, out + i, in, from, to);
    for (; i < outs; ++i)
        multiply_rows(One(), matrix + i * ins, ins, out + i, in, from, to);
};
// Rows of moments, which lie far apart, are copied to where they do not take each other's places in
// a processor's cache; the next row is asked for in time.
auto moment_row = [&](int k) -> F* { return scratch_row(k); };
auto pair_row = [&](int i) -> F* { return scratch_row(POINTERS + i); };
// A moment of light; light is given as mean, flux along z, y, x, and what is higher.
auto part_of = [&](const F* const* parts, int k) -> const F* {
    const int places[4] = {0, 2, 1, 3};
    return k < 4 ? parts[places[k]] : parts[4] ? parts[4] + (k - 4) * all : nullptr;
};
// Sums of rows, each by a number: of a moment, what `find_terms` puts into `rows` and `by`.
struct Terms { const F* rows[POINTERS][3]; F by[POINTERS][3]; };
// One of the moments that scatter, from a cell on.
auto find_scattering = [&](long long at, int k, const F** rows, F* by) {
    const F* light = part_of(light_parts, k);
    const F* source = beam_factors ? source_parts[0] : part_of(source_parts, k);
    rows[0] = light ? light + at : empty_row;
    rows[1] = source ? source + at : empty_row;
    by[0] = light ? factors[k * colors + color] : F(0);
    by[1] = !source ? F(0) : beam_factors ? beam_factors[k * colors + color] : F(1);
};
// So few moments stay in registers: `Vectors` of cells, then single `Numbers`.
struct Vectors { typedef V T; enum { count = LANES }; };
struct Numbers { typedef F T; enum { count = 1 }; };
auto in_steps = [](int from, int to, auto step) {
    int c = from;
    for (; c + LANES <= to; c += LANES) step(Vectors(), c);
    for (; c < to; ++c) step(Numbers(), c);
};
// Rows of a group's pairs.
auto rows_of_pairs = [&](auto light, F** ones, F** others) {
    for (int p = 0; p < pair_count; ++p) {
        ones[p] = light(pair[2 * p]);
        others[p] = pair[2 * p + 1] < 0 ? nullptr : light(pair[2 * p + 1]);
    }
};
auto few_to_directions = [&](auto evens, auto odds, const F* matrix, auto moment, auto light,
                             int from, int to) {
    constexpr int E = decltype(evens)::value, O = decltype(odds)::value;
    F *ones[POINTERS], *others[POINTERS];
    rows_of_pairs(light, ones, others);
    const F* odd_matrix = matrix + pair_count * E;
    in_steps(from, to, [&](auto cells, int c) {
        typedef typename decltype(cells)::T T;
        T in[E + O];
#pragma clang loop unroll(full)
        for (int k = 0; k < E + O; ++k) in[k] = moment(cells, k, c);
        for (int p = 0; p < pair_count; ++p) {
            T sum = matrix[p * E] * in[0], difference{};
#pragma clang loop unroll(full)
            for (int k = 1; k < E; ++k) sum += matrix[p * E + k] * in[k];
            if (p < odd_count)
#pragma clang loop unroll(full)
                for (int k = 0; k < O; ++k) difference += odd_matrix[p * O + k] * in[E + k];
            *(T*)(ones[p] + c) = sum + difference;
            if (others[p]) *(T*)(others[p] + c) = sum - difference;
        }
    });
};
auto few_to_moments = [&](auto evens, auto odds, const F* matrix, auto begin, auto end, auto light,
                          int from, int to) {
    constexpr int E = decltype(evens)::value, O = decltype(odds)::value;
    F *ones[POINTERS], *others[POINTERS];
    rows_of_pairs(light, ones, others);
    const F* odd_matrix = matrix + pair_count * E;
    in_steps(from, to, [&](auto cells, int c) {
        typedef typename decltype(cells)::T T;
        T out[E + O];
#pragma clang loop unroll(full)
        for (int k = 0; k < E + O; ++k) out[k] = begin(cells, k, c);
        for (int p = 0; p < pair_count; ++p) {
            const T one = *(const T*)(ones[p] + c);
            T sum = one, difference = one;
            if (others[p]) {
                const T other = *(const T*)(others[p] + c);
                sum = one + other;
                difference = one - other;
            }
#pragma clang loop unroll(full)
            for (int k = 0; k < E; ++k) out[k] += matrix[k * pair_count + p] * sum;
            if (p < odd_count)
#pragma clang loop unroll(full)
                for (int k = 0; k < O; ++k)
                    out[E + k] += odd_matrix[k * odd_count + p] * difference;
        }
#pragma clang loop unroll(full)
        for (int k = 0; k < E + O; ++k) end(cells, k, c, out[k]);
    });
};
// Radiance of a group's directions, `light(j)`, from moments that are sums of so many `terms`.
auto to_directions = [&](const F* matrix, auto terms, auto find_terms, auto light, int from,
                         int to) __attribute__((noinline)) {
    constexpr int N = decltype(terms)::value;
    Terms sums;
    for (int k = 0; k < count; ++k) find_terms(order[k], sums.rows[k], sums.by[k]);
    auto moment = [&](auto cells, int k, int c) -> typename decltype(cells)::T {
        typedef typename decltype(cells)::T T;
        T sum{};
#pragma clang loop unroll(full)
        for (int i = 0; i < N; ++i) {
            const F* row = sums.rows[k][i] + c;
            sum += sums.by[k][i] * *(const T*)row;
            if (decltype(cells)::count > 1) __builtin_prefetch(row + ahead);
        }
        return sum;
    };
    if (even == 3 && odd == 1) {
        few_to_directions(Three(), One(), matrix, moment, light, from, to);
        return;
    }
    if (even == 10 && odd == 6) {
        few_to_directions(Ten(), Six(), matrix, moment, light, from, to);
        return;
    }
    const F* in[POINTERS];
    F* out[POINTERS];
    for (int k = 0; k < count; ++k) {
        F* row = moment_row(k);
        in[k] = row;
        in_steps(from, to, [&](auto cells, int c) {
            *(typename decltype(cells)::T*)(row + c) = moment(cells, k, c);
        });
    }
    for (int p = 0; p < pair_count; ++p)
        out[p] = p < odd_count ? pair_row(2 * p) : light(pair[2 * p]);
    multiply(matrix, pair_count, even, out, in, from, to);
    for (int p = 0; p < odd_count; ++p) out[p] = pair_row(2 * p + 1);
    multiply(matrix + pair_count * even, odd_count, odd, out, in + even, from, to);
    for (int p = 0; p < odd_count; ++p) {
        const F *sum = pair_row(2 * p), *difference = pair_row(2 * p + 1);
        F *one = light(pair[2 * p]), *other = pair[2 * p + 1] < 0 ? one : light(pair[2 * p + 1]);
        INDEPENDENT
        for (int c = from; c < to; ++c) {
            const F a = sum[c], b = difference[c];
            other[c] = a - b;
            one[c] = a + b;
        }
    }
};
// The transpose: moments that `begin` at a cell, or what is added to them, from radiance. Those
// that nothing is in yet begin with `first` in the mean, less the parts that are `taken`.
auto to_moments = [&](const F* matrix, F* begin, auto light, bool is_adding, F first,
                      const F* const* taken, long long at, int from, int to) {
    F* found[POINTERS];
    const F* less[POINTERS];
    for (int k = 0; k < count; ++k) {
        const F* part = taken && order[k] < 4 ? part_of(taken, order[k]) : nullptr;
        found[k] = begin + order[k] * all;
        less[k] = part ? part + at : empty_row;
    }
    auto begun = [&](auto cells, int k, int c) -> typename decltype(cells)::T {
        typedef typename decltype(cells)::T T;
        if (!is_adding) return (order[k] ? F(0) : first) - *(const T*)(less[k] + c);
        if (decltype(cells)::count > 1) __builtin_prefetch(found[k] + ahead + c);
        return *(const T*)(found[k] + c);
    };
    auto end = [&](auto cells, int k, int c, auto value) {
        *(typename decltype(cells)::T*)(found[k] + c) = value;
    };
    if (even == 3 && odd == 1) {
        few_to_moments(Three(), One(), matrix, begun, end, light, from, to);
        return;
    }
    if (even == 10 && odd == 6) {
        few_to_moments(Ten(), Six(), matrix, begun, end, light, from, to);
        return;
    }
    const F *sums[POINTERS], *differences[POINTERS];
    F* out[POINTERS];
    for (int p = 0; p < pair_count; ++p) {
        const F* one = light(pair[2 * p]);
        sums[p] = differences[p] = one;
        if (pair[2 * p + 1] < 0) continue;
        const F* other = light(pair[2 * p + 1]);
        F *sum = pair_row(2 * p), *difference = pair_row(2 * p + 1);
        sums[p] = sum, differences[p] = difference;
        INDEPENDENT
        for (int c = from; c < to; ++c) {
            const F a = one[c], b = other[c];
            sum[c] = a + b;
            difference[c] = a - b;
        }
    }
    for (int k = 0; k < count; ++k) out[k] = moment_row(k);
    multiply(matrix, even, pair_count, out, sums, from, to);
    multiply(matrix + even * pair_count, odd, odd_count, out + even, differences, from, to);
    for (int k = 0; k < count; ++k) {
        const F* row = moment_row(k);
        F* moment = found[k];
        in_steps(from, to, [&](auto cells, int c) {
            typedef typename decltype(cells)::T T;
            *(T*)(moment + c) = begun(cells, k, c) + *(const T*)(row + c);
        });
    }
};
"""
