"""Rows of moments from rows of radiance along directions, and the other way around, in C++ (E17).

Products of small matrices with rows: out_i = sum_j matrix_ij in_j, from one cell to another. A
direction and its mirror image in x, a pair, share sums over moments even and odd in x.
"""

MULTIPLY = """
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
auto ask_for = [&](const F* row, int from, int to) {
    for (int c = from; c < to; c += 64 / (int)sizeof(F)) __builtin_prefetch(row + ahead + c);
};
// A moment of light; light is given as mean, flux along z, y, x, and what is higher.
auto part_of = [&](F* const* parts, int k) -> const F* {
    const int places[4] = {0, 2, 1, 3};
    return k < 4 ? parts[places[k]] : parts[4] ? parts[4] + (k - 4) * all : nullptr;
};
// One of the moments that scatter, from a cell on.
auto read_scattering = [&](long long at, int k, F* row, int from, int to) {
    const F* light = part_of(light_parts, k);
    const F* source = beam_factors ? source_parts[0] : part_of(source_parts, k);
    if (!light && !source) {
        for (int c = from; c < to; ++c) row[c] = F(0);
        return;
    }
    const F by_light = light ? factors[k * colors + color] : F(0);
    const F by_source
        = !source ? F(0) : beam_factors ? beam_factors[k * colors + color] : F(1);
    const F *one = (light ? light : source) + at, *other = (source ? source : light) + at;
    INDEPENDENT
    for (int c = from; c < to; ++c) row[c] = by_light * one[c] + by_source * other[c];
    ask_for(one, from, to);
    if (other != one) ask_for(other, from, to);
};
// Radiance of a group's directions, `light(j)`, from rows of moments that `read` gets.
auto to_directions = [&](const F* matrix, auto read, auto light, int from, int to) {
    const F* in[POINTERS];
    F* out[POINTERS];
    for (int k = 0; k < count; ++k) {
        read(order[k], moment_row(k), from, to);
        in[k] = moment_row(k);
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
// The transpose: moments that `begin` at a cell, or what is added to them, from radiance.
auto to_moments = [&](const F* matrix, F* begin, auto light, bool is_adding, int from, int to) {
    const F *sums[POINTERS], *differences[POINTERS];
    F* out[POINTERS];
    for (int k = 0; k < count && is_adding; ++k) ask_for(begin + k * all, from, to);
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
        F* moment = begin + order[k] * all;
        const F* row = moment_row(k);
        INDEPENDENT
        for (int c = from; c < to; ++c) moment[c] = is_adding ? moment[c] + row[c] : row[c];
    }
};
"""
