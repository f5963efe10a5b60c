#pragma once
#include "ddrecon/kernels/numbers.h"
// Passes of multigrid and of conjugate gradients over the cells of a grid (`hierarchy.py` and
// `solve.py` have the formulas). An item does a row or a slice of cells on a processor, and a cell
// or a pair on a GPU. No item reads what another one writes.

namespace ddrecon {

typedef long long Size;

// clang-format off
enum Kind {
    SCALE, WEIGH, STIFFEN, SMOOTH, RESIDUAL, RELAX, RESTRICT, CORRECT, DESCEND, ASCEND, SOLVE, TURN,
    PRODUCT, ADVANCE
};
// clang-format on

// A pass, as `fused/passes.py` lists it: its kind, its items and their width; the grid, with a bit
// for each axis that is periodic; the axis along which cells become pairs, and how many there were;
// the number of colors of faces and of cells; the number of a relaxation; places in `work` of
// vectors, of the five numbers of each color, and of an item's sum, or 0; and addresses of an
// operator's arrays, of a level's, of a coarsening's weights, and of what a preparation writes. The
// grid of pairs is the number of cells before an axis, along it and behind it.
template <class F> struct Pass {
    Size kind, items, width, n[3], periodic, axis, cells, face_colors, cell_colors, step;
    Size u, source, out, numbers, sums, steps, axes[3];
    const F *c[3], *loss, *inverse, *coupling, *below, *above, *belows[3], *aboves[3];
    F* results[6];
};

// How far the cells beyond the faces of a cell lie, along each axis: its ends are neighbors.
struct Offsets {
    Size below[3], above[3];
};
// The cells of an item, side by side from the one at z, y, x on, which is number `start` of its
// color; and functions of seven points.
template <class F> struct Cells {
    const int nz, ny, nx, width;
    const Size count;
    const bool is_periodic;
    int color, face_color, cell_color, z, y, x;
    Size start;
    const F* c[3];

    INLINE Cells(const Pass<F>& p, Size item)
        : nz((int)p.n[0]),
          ny((int)p.n[1]),
          nx((int)p.n[2]),
          width((int)p.width),
          count((Size)nz * ny * nx),
          is_periodic(p.periodic & 6) {
        color = (int)(item * width / count);
        face_color = color % p.face_colors, cell_color = color % p.cell_colors;
        start = item * width - color * count;
        const int row = (int)(start / nx);
        z = row / ny, y = row % ny, x = (int)(start - (Size)row * nx);
        UNROLLED
        for (int a = 0; a < 3; ++a) c[a] = p.c[a] + at(face_color);
    }
    // The place of the item in an array of colors.
    INLINE Size at(int color) const { return color * count + start; }
    INLINE Offsets around(int y, int x) const {
        const Size slice = (Size)ny * nx;
        return {
            {z > 0 ? -slice : (nz - 1) * slice, y > 0 ? -nx : (ny - 1) * nx, x > 0 ? -1 : nx - 1},
            {z < nz - 1 ? slice : (1 - nz) * slice, y < ny - 1 ? nx : (1 - ny) * nx,
             x < nx - 1 ? 1 : 1 - nx}};
    }
    // Calls `act` for each cell of a slice. Faces on the box are zero: it makes no difference which
    // cell lies beyond them, so rows are one loop. The first or last row is by itself where the
    // grid ends there, and so is every row where rows or columns are periodic.
    template <class Act> INLINE void visit(const Act& act) const {
        if (IS_GPU) return act(0, around(y, x));
        const int from = is_periodic ? ny : z == 0, to = is_periodic ? 0 : ny - (z == nz - 1);
        for (int row = 0, next; row < ny; row = next) {
            const bool is_alone = row < from || row >= to;
            next = is_alone ? row + 1 : to;
            visit_rows(row, row * nx, next * nx, is_alone, act);
        }
    }
    // The same of rows from y on, which are cells `begin` to `end` of the item, or of one `alone`.
    // Here alone calls are inlined: what is compiled is short.
    template <class Act>
    INLINE void visit_rows(int y, int begin, int end, bool alone, const Act& act) const {
        if (IS_GPU) return act(0, around(y, x));
        Offsets offsets = around(y, 0);
        if (!alone) offsets.below[1] = -nx, offsets.above[1] = nx;
        offsets.below[2] = -1, offsets.above[2] = 1;
        INDEPENDENT
        for (int i = begin + alone; i < end - alone; ++i) act(i, offsets);
        for (int x = 0; alone && x < nx; x += nx > 1 ? nx - 1 : 1) act(begin + x, around(y, x));
    }
    // Calls `act(c, k)` for the six faces of cell i: what a face conducts, and the cell beyond it.
    template <class Act> INLINE void at_faces(int i, const Offsets& to, const Act& act) const {
        UNROLLED
        for (int a = 0; a < 3; ++a) {
            act(c[a][i], i + to.above[a]);
            act(c[a][i + to.below[a]], i + to.below[a]);
        }
    }
    // What neighbors send, the sum of c u', and what a cell exchanges with them, of c (u - u').
    template <class U> INLINE F sent(int i, const Offsets& to, const U& u) const {
        F sum = 0;
        at_faces(i, to, [&](F c, Size k) HERE { sum += c * u(k); });
        return sum;
    }
    INLINE F exchanged(int i, const Offsets& to, const F* u) const {
        F sum = 0;
        at_faces(i, to, [&](F c, Size k) HERE { sum += c * (u[i] - u[k]); });
        return sum;
    }
};

// 1 / diagonal, and the part of the diagonal that is exchanged.
template <class F> INLINE void scale(const Pass<F>& p, Size item) {
    const Cells<F> cells(p, item);
    const F* const loss = p.loss + cells.at(cells.cell_color);
    F* const inverse = p.results[0] + cells.at(cells.color);
    F* const coupling = p.results[1] + cells.at(cells.color);
    cells.visit([&](int i, const Offsets& to) HERE {
        const F exchanged = cells.sent(i, to, [](Size) HERE { return F(1); });
        inverse[i] = 1 / (exchanged + loss[i]);
        coupling[i] = exchanged * inverse[i];
    });
}
// The coupling times b - A u; or relaxations by the steps `first` and `second`.
template <class F> INLINE void relax(const Pass<F>& p, F* work, F first, F second, Size item) {
    const Cells<F> cells(p, item);
    const F* const b = work + p.source + cells.at(cells.color);
    const F* const u = work + p.u + cells.at(cells.color);
    const F* const loss = p.loss + cells.at(cells.cell_color);
    const F* const inverse = p.inverse + cells.at(cells.cell_color);
    const F* const coupling = p.coupling + cells.at(cells.cell_color);
    F* const out = work + p.out + cells.at(cells.color);
    if (p.kind == RESIDUAL)
        cells.visit([&](int i, const Offsets& to) HERE {
            out[i] = coupling[i] * (b[i] - (loss[i] * u[i] + cells.exchanged(i, to, u)));
        });
    if (p.kind == SMOOTH) {
        // The first step makes u = first b / diagonal; the second relaxes that.
        const F both = first * second, either = first + second - both;
        cells.visit([&](int i, const Offsets& to) HERE {
            const F sent = cells.sent(i, to, [&](Size k) HERE { return inverse[k] * b[k]; });
            out[i] = inverse[i] * (either * b[i] + both * sent);
        });
    }
    if (p.kind == RELAX) {
        const F step = p.step ? second : first;
        F sum = 0;
        cells.visit([&](int i, const Offsets& to) HERE {
            REORDERED
            const F sent = cells.sent(i, to, [&](Size k) HERE { return u[k]; });
            out[i] = (1 - step) * u[i] + step * inverse[i] * (b[i] + sent);
            sum += out[i] * b[i];
        });
        if (p.sums) work[p.sums + item] = sum;
    }
}
// The numbers of `TensorSteps`, and a ratio of two of them.
enum Number { POWER, PREVIOUS, CURVATURE, SQUARE, LEAST };
template <class F> INLINE F ratio(F above, F below) {
    const F tiny = F(sizeof(F) == 8 ? 0x1p-1022 : 0x1p-126);
    return (above > tiny ? above : tiny) / (below > tiny ? below : tiny);
}
// Steps of conjugate gradients, of directions d and residuals r, with sums of products.
template <class F> INLINE void advance(const Pass<F>& p, F* work, F* solution, Size item) {
    const Cells<F> cells(p, item);
    const F* const loss = p.loss + cells.at(cells.cell_color);
    const F* const inverse = p.inverse + cells.at(cells.cell_color);
    const F* const in = work + p.source + cells.at(cells.color);
    F* const number = work + p.numbers + 5 * cells.color;
    const F step = p.kind == TURN                   ? ratio(number[POWER], number[PREVIOUS])
                   : number[SQUARE] > number[LEAST] ? ratio(number[POWER], number[CURVATURE])
                                                    : F(0);
    F* const d = work + p.u + cells.at(cells.color);
    F* const out = work + p.out + cells.at(cells.color);
    F* const u = solution + cells.at(cells.color);
    F sum = 0;
    if (p.kind == TURN) {
        INDEPENDENT
        for (int i = 0; i < cells.width; ++i) d[i] = in[i] + step * d[i];
        return;
    }
    if (p.kind == PRODUCT)
        cells.visit([&](int i, const Offsets& to) HERE {
            REORDERED
            out[i] = loss[i] * d[i] + cells.exchanged(i, to, d);
            sum += d[i] * out[i];
        });
    if (p.kind == ADVANCE) {
        REORDERED
        if (cells.start == 0) number[PREVIOUS] = number[POWER]; // which nobody reads meanwhile
        INDEPENDENT
        for (int i = 0; i < cells.width; ++i) {
            u[i] += step * d[i];
            out[i] -= step * in[i];
            sum += out[i] * out[i] * inverse[i];
        }
    }
    work[p.sums + item] = sum;
}
template <class F> INLINE void solve(const Pass<F>& p, F* work, Size item) {
    REORDERED
    const Size n = p.n[0] * p.n[1] * p.n[2], color = item / n;
    const F* const row = p.inverse + (color % p.cell_colors * n + item % n) * n;
    const F* const b = work + p.source + color * n;
    double sum = 0;
    for (Size k = 0; k < n; ++k) sum += (double)row[k] * (double)b[k];
    work[p.out + item] = (F)sum;
    if (p.sums) work[p.sums + item] = (F)sum * b[item % n];
}

// Pairs of cells along an axis: those of an item are, on a processor, pairs number `first` of so
// many lines side by side, or all pairs of a line along x.
template <bool ALONG_X, class F> struct Pairs {
    const int cells, count, width;
    const Size step;
    int color, face_color, cell_color, first;
    Size fine_size, fine_start, coarse_size, coarse_start;

    INLINE Pairs(const Pass<F>& p, Size item)
        : cells((int)p.n[1]),
          count((cells + 1) / 2),
          width((int)p.width),
          step(ALONG_X ? 1 : p.n[2]),
          fine_size(p.n[0] * cells * step),
          coarse_size(p.n[0] * count * step) {
        color = (int)(item * p.width / coarse_size);
        face_color = color % p.face_colors, cell_color = color % p.cell_colors;
        coarse_start = item * p.width - color * coarse_size;
        const Size row = coarse_start / step;
        first = (int)(row % count);
        coarse_start -= first * step;
        fine_start = row / count * cells * step + coarse_start % step;
    }
    // The place of the item's first line in an array of fine or of coarse cells, of colors.
    INLINE Size fine(int color) const { return color * fine_size + fine_start; }
    INLINE Size coarse(int color) const { return color * coarse_size + coarse_start; }
    // Calls `act` for each pair with its number, its line, and whether it certainly lies between
    // two others: that loop is vector code.
    template <class Act> INLINE void visit(const Act& act) const {
        if (!ALONG_X) {
            INDEPENDENT
            for (int line = 0; line < width; ++line) act(first, line, false);
            return;
        }
        INDEPENDENT
        for (int k = 1; k < count - 1; ++k) act(k, 0, true);
        act(0, 0, false);
        if (count > 1) act(count - 1, 0, false);
    }
    // The pairs beside pair k: the ends of a line are neighbors. The last pair may be one cell.
    INLINE int before(int k, bool inner) const { return inner || k > 0 ? k - 1 : count - 1; }
    INLINE int behind(int k, bool inner) const { return inner || k < count - 1 ? k + 1 : 0; }
    INLINE bool has_second(int k, bool inner) const { return inner || 2 * k + 1 < cells; }
};

// Resistors from a pair's center to the next pair's: their parts within either pair, and what all
// of them conduct. Conductances across the axis, and losses, are sums of pairs.
template <bool ALONG_X, class F> INLINE void weigh(const Pass<F>& p, Size item) {
    const Pairs<ALONG_X, F> pairs(p, item);
    const auto sum_pairs = [&](const F* from, F* to) HERE {
        pairs.visit([&](int k, int line, bool inner) HERE {
            const F* const first = from + 2 * k * pairs.step + line;
            const bool is_pair = pairs.has_second(k, inner);
            to[k * pairs.step + line] = *first + (is_pair ? first[pairs.step] : F(0));
        });
    };
    const Size fine = pairs.fine(pairs.color), coarse = pairs.coarse(pairs.color);
    if (pairs.color < p.cell_colors) sum_pairs(p.loss + fine, p.results[5] + coarse);
    if (pairs.color >= p.face_colors) return;
    for (int k = 1; k < 3; ++k) sum_pairs(p.c[k] + fine, p.results[2 + k] + coarse);
    const F* const along = p.c[0] + fine;
    F *const below = p.results[0] + coarse, *const above = p.results[1] + coarse;
    F* const c = p.results[2] + coarse;
    pairs.visit([&](int k, int line, bool inner) HERE {
        const int next = pairs.behind(k, inner);
        const bool is_pair = pairs.has_second(k, inner), has_next = pairs.has_second(next, false);
        const F *const first = along + 2 * k * pairs.step + line, *const second =
                                                                      is_pair ? first + pairs.step
                                                                              : first;
        const F half = F(0.5) / *first, next_half = F(0.5) / along[2 * next * pairs.step + line];
        const F low = is_pair ? half : F(0), high = has_next ? next_half : F(0);
        const F conducted = pairs.count > 1 ? 1 / (low + 1 / *second + high) : F(0);
        const Size at = k * pairs.step + line;
        below[at] = low * conducted;
        above[at] = high * conducted;
        c[at] = conducted;
    });
}
// To what coarse faces along the axis conduct, the energy of what runs across it is added: half of
// c (w - w')^2 of the fine cells below and above the face between a pair and the next one.
template <int AXIS, class F> INLINE void stiffen(const Pass<F>& p, Size item) {
    const Cells<F> cells(p, item);
    const Size counts[3] = {cells.nz, cells.ny, cells.nx}, count = counts[AXIS];
    const Size step = AXIS == 0 ? counts[1] * counts[2] : AXIS == 1 ? counts[2] : 1;
    const F* const below = p.below + cells.at(cells.color);
    const F* const above = p.above + cells.at(cells.color);
    F* const along = p.results[0] + cells.at(cells.color);
    // The first cell of the line of fine cells through the item.
    const Size line = cells.at(cells.color) / (count * step) * p.cells * step + cells.start % step;
    cells.visit_rows(cells.y, 0, cells.nx, true, [&](int i, const Offsets& to) HERE {
        const Size k = cells.start / step % count + (AXIS == 2 ? i : 0);
        const Size second = 2 * k + 1 < p.cells ? 2 * k + 1 : 2 * k, next = (k + 1) % count * 2;
        F energy = 0;
        UNROLLED
        for (int across = 0; across < 3; ++across) {
            if (across == AXIS) continue;
            const F* const c = p.c[across] + line + (AXIS == 2 ? 0 : i);
            UNROLLED
            for (int side = 0; side < 2; ++side) {
                const Size beside = side ? to.above[across] : to.below[across];
                const F w = below[i] - below[i + beside], v = above[i] - above[i + beside];
                // The face's numbers are those of the cell below it.
                const Size shift = across < AXIS ? beside / count * p.cells : beside;
                const F* const face = side ? c : c + shift;
                energy += face[second * step] * w * w + face[next * step] * v * v;
            }
        }
        along[i] += F(0.5) * energy;
    });
}
// Sums of pairs, less what their cells send to the pairs beside them, plus what those send: the
// transpose of `correct`.
template <bool ALONG_X, class F> INLINE void restrict(const Pass<F>& p, F* work, Size item) {
    const Pairs<ALONG_X, F> pairs(p, item);
    const F* const fine = work + p.source + pairs.fine(pairs.color);
    const F* const below = p.below + pairs.coarse(pairs.face_color);
    const F* const above = p.above + pairs.coarse(pairs.face_color);
    F* const out = work + p.out + pairs.coarse(pairs.color);
    pairs.visit([&](int k, int line, bool inner) HERE {
        const int before = pairs.before(k, inner), behind = pairs.behind(k, inner);
        const auto first = [&](int k) HERE { return fine[2 * k * pairs.step + line]; };
        const auto second = [&](int k, bool inner) HERE {
            return fine[(pairs.has_second(k, inner) ? 2 * k + 1 : 2 * k) * pairs.step + line];
        };
        const Size at = k * pairs.step + line, under = before * pairs.step + line;
        const F pair = (1 - below[at]) * second(k, inner);
        out[at] = (1 - above[under]) * first(k) + (pairs.has_second(k, inner) ? pair : F(0)) +
                  below[under] * second(before, inner) + above[at] * first(behind);
    });
}
// Cells between their pair's value and that of the pair beside them; or the coupling times that,
// added.
template <bool ALONG_X, bool ADDS, class F>
INLINE void correct(const Pass<F>& p, F* work, Size item) {
    const Pairs<ALONG_X, F> pairs(p, item);
    const F* const u = work + p.source + pairs.coarse(pairs.color);
    const F* const below = p.below + pairs.coarse(pairs.face_color);
    const F* const above = p.above + pairs.coarse(pairs.face_color);
    F* const out = work + p.out + pairs.fine(pairs.color);
    const F* const coupling = ADDS ? p.coupling + pairs.fine(pairs.cell_color) : out;
    const auto put = [&](Size at, F value) HERE {
        out[at] = ADDS ? out[at] + coupling[at] * value : value;
    };
    pairs.visit([&](int k, int line, bool inner) HERE {
        const Size at = k * pairs.step + line;
        const Size before = pairs.before(k, inner) * pairs.step + line;
        const Size behind = pairs.behind(k, inner) * pairs.step + line;
        const Size first = 2 * k * pairs.step + line;
        put(first, u[at] + above[before] * (u[before] - u[at]));
        if (pairs.has_second(k, inner))
            put(first + pairs.step, u[at] + below[at] * (u[behind] - u[at]));
    });
}
template <bool ALONG_X, class F> INLINE void transfer(const Pass<F>& p, F* work, Size item) {
    if (p.kind == RESTRICT) return restrict<ALONG_X>(p, work, item);
    p.coupling ? correct<ALONG_X, true>(p, work, item) : correct<ALONG_X, false>(p, work, item);
}

// All coarsenings of a level at once, as a GPU does them: a number of a grid of z, y, x is made of
// those of the grid before or behind it, and so on.
template <class F> struct Steps {
    const Pass<F>& p;
    const F* numbers;
    int color, face_color;

    // The place of a cell on the grid after so many coarsenings, and of its color.
    INLINE Size at(int step, int color, const int* cell) const {
        Size place = color;
        UNROLLED
        for (int a = 0; a < 3; ++a) place = place * count(step, a) + cell[a];
        return place;
    }
    INLINE int count(int step, int axis) const {
        int n = (int)p.n[axis];
        for (int k = 0; k < step; ++k) n = p.axes[k] == axis ? (n + 1) / 2 : n;
        return n;
    }
    // As `restrict`, of the grid after STEP coarsenings.
    template <int STEP> INLINE F restricted(const int* cell) const {
        if constexpr (STEP == 0) {
            return numbers[at(0, color, cell)];
        } else {
            const int axis = (int)p.axes[STEP - 1], n = count(STEP - 1, axis), k = cell[axis];
            const int last = (n + 1) / 2 - 1, under = k > 0 ? k - 1 : last;
            const int behind = k < last ? k + 1 : 0;
            int from[3] = {cell[0], cell[1], cell[2]};
            const Size here = at(STEP, face_color, from);
            from[axis] = under;
            const Size there = at(STEP, face_color, from);
            const F *const below = p.belows[STEP - 1], *const above = p.aboves[STEP - 1];
            const int cells[4] = {2 * k, 2 * k + 1, 2 * under + (2 * under + 1 < n), 2 * behind};
            const F parts[4] = {1 - above[there], 1 - below[here], below[there], above[here]};
            F sum = 0;
            for (int i = 0; i < 4; ++i) {
                from[axis] = cells[i];
                if (cells[i] < n) sum += parts[i] * restricted<STEP - 1>(from);
            }
            return sum;
        }
    }
    // As `correct`, on the grid after STEP coarsenings.
    template <int STEP> INLINE F prolonged(const int* cell) const {
        if (STEP == p.steps) return numbers[at(STEP, color, cell)];
        if constexpr (STEP < 3) {
            const int axis = (int)p.axes[STEP], last = (count(STEP, axis) + 1) / 2 - 1;
            int pair[3] = {cell[0], cell[1], cell[2]};
            const int k = pair[axis] /= 2, is_second = cell[axis] % 2;
            const F value = prolonged<STEP + 1>(pair);
            Size face = at(STEP + 1, face_color, pair);
            pair[axis] = is_second ? (k < last ? k + 1 : 0) : (k > 0 ? k - 1 : last);
            if (!is_second) face = at(STEP + 1, face_color, pair);
            const F stiffness = (is_second ? p.belows : p.aboves)[STEP][face];
            return value + stiffness * (prolonged<STEP + 1>(pair) - value);
        }
        return 0;
    }
};
template <class F> INLINE void descend(const Pass<F>& p, F* work, Size item) {
    Steps<F> steps{p, work + p.source};
    const int z = steps.count((int)p.steps, 0), y = steps.count((int)p.steps, 1);
    const int x = steps.count((int)p.steps, 2);
    steps.color = (int)(item / ((Size)z * y * x));
    steps.face_color = steps.color % p.face_colors;
    const int cell[3] = {(int)(item / ((Size)y * x) % z), (int)(item / x % y), (int)(item % x)};
    work[p.out + item] = p.steps == 1   ? steps.template restricted<1>(cell)
                         : p.steps == 2 ? steps.template restricted<2>(cell)
                                        : steps.template restricted<3>(cell);
}
template <class F> INLINE void ascend(const Pass<F>& p, F* work, Size item) {
    const Cells<F> cells(p, item);
    const int cell[3] = {cells.z, cells.y, cells.x};
    const Steps<F> steps{p, work + p.source, cells.color, cells.face_color};
    work[p.out + item] +=
        p.coupling[cells.at(cells.cell_color)] * steps.template prolonged<0>(cell);
}

// An item of a pass that prepares a hierarchy, or of one of an iteration.
template <class F> INLINE void prepare(const Pass<F>& p, F*, F*, F, F, Size item) {
    if (p.kind == SCALE) scale(p, item);
    if (p.kind == WEIGH) p.n[2] == 1 && !IS_GPU ? weigh<!IS_GPU>(p, item) : weigh<false>(p, item);
    if (p.kind != STIFFEN) return;
    if (p.axis == 0) stiffen<0>(p, item);
    if (p.axis == 1) stiffen<1>(p, item);
    if (p.axis == 2) stiffen<2>(p, item);
}
template <class F>
INLINE void iterate(const Pass<F>& p, F* work, F* solution, F first, F second, Size item) {
    if constexpr (IS_GPU) {
        if (p.kind == DESCEND) return descend(p, work, item);
        if (p.kind == ASCEND) return ascend(p, work, item);
    }
    if (p.kind == SOLVE) return solve(p, work, item);
    if (p.kind >= TURN) return advance(p, work, solution, item);
    if (p.kind < RESTRICT) return relax(p, work, first, second, item);
    p.n[2] == 1 && !IS_GPU ? transfer<!IS_GPU>(p, work, item) : transfer<false>(p, work, item);
}

} // namespace ddrecon
