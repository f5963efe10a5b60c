#pragma once
#include "ddrecon/transport/fused/step.h"
// Radiance along discrete ordinates, and its moments (E2.9, E2.8).
//
// A cell takes light from up to four cells of the slice upwind, across the axis along which an
// ordinate crosses most cells, and from none of its own slice.
//
// By rows, for a processor: an item is a team of ordinates of one color, which go through the
// planes across z in the same order. In a plane they go through the rows twice: up in y with those
// ordinates that do, and down with the others. Whatever the slices of an ordinate are, across z or
// y, cells upwind were done before; across x, what comes from cells of the same row is carried on
// from cell to cell. Other loops over the cells of a row are vector code, and sums over ordinates
// are formed row by row.
//
// By cells, for a GPU: an item is a cell of a slice, for one ordinate and color. A launch does one
// slice of every ordinate; what ordinates give is summed later. With faces, also on a processor:
// light enters there, and what leaves by a face of a periodic grid enters by the opposite one.

#if IS_GPU
#define APART INLINE
#else
// Compiled apart from what calls it, so that loops have registers to themselves.
#define APART __attribute__((noinline))
#endif

namespace ddrecon {

// Ordinates from `begin` on; those from `middle` to `end` go down in y. `sense` along z: 1 or -1.
struct Team {
    int begin, middle, end, sense;
};
// An ordinate: the axis across which its slices lie, its senses along z, y and x, and how many
// points upwind it takes light from: one or four, each so many cells upwind along z and so far
// along y and x.
struct Ordinate {
    int axis, senses[3], count, back[4], shifts[4];
};
// The path through a cell [u], cells moved along z, y, x on it, and weights of the points.
template <class F> struct Path {
    F step, moved[3], weights[4];
};

// What kernels are given. Arrays are [..., colors, cells]; tangents have d_ before their names.
// `values` and `weighted` [ordinates, count]: harmonics, and these times quadrature weights;
// `scales` [3, colors]: factors of the fields extinction and scattering [1 or colors, cells], and
// what light enters the box; `densest` [1 or colors, depth, height]: the most of extinction in a
// row. `light` is I where it leaves cells, less that inflow, and `returning`
// are cotangents of I where it enters them: for each ordinate and color a ring of `planes` or
// `back_planes` planes, numbered from where the team begins, with a rim of zeros. `outputs` are
// what ordinates give in each cell, to be summed. A launch has ordinates from `first` on, teams
// from `team` on, `together` colors from `color` on, and `lanes` items for a team and color.
// It does planes `begin` to `end`, or the slice `begin`.
template <class F> struct Sweep {
    const int *teams, *ordinates;
    const F *paths, *values, *weighted, *ones, *scales, *extinction, *densest;
    const F *scattering, *gradient;
    const F *source, *bars, *d_scales, *d_extinction, *d_scattering, *d_gradient, *d_source;
    const F* entering;
    F *light, *returning, *scratch, *outputs, *moments, *gradient_bar, *e_bar, *sc_bar;
    double* inflow_bar;
    int depth, height, width, periodic, count, colors, extinctions, scatterings, planes,
        back_planes;
    int pitch, most, first, launched, team, color, together, lanes, begin, end;
};

// The product of a matrix `by` with rows `in`, which is added to rows `out`. Rows lie `apart` from
// each other, and so do the matrix's numbers for the next row of either.
template <class F> struct Product {
    F* out;
    long long out_apart;
    const F* in;
    long long in_apart;
    const F* by;
    int by_out, by_in;

    // Blocks of rows share reads: OUTS from row a on, INS from row b on.
    template <int OUTS, int INS> INLINE void add_block(int a, int b, int width) const {
        F *const sums = out + a * out_apart, factor[OUTS][INS];
        const F *const rows = in + b * in_apart, *const corner = by + a * by_out + b * by_in;
        const long long out_apart = this->out_apart, in_apart = this->in_apart;
        UNROLLED
        for (int n = 0; n < OUTS * INS; ++n)
            factor[n / INS][n % INS] = corner[n / INS * by_out + n % INS * by_in];
        INDEPENDENT
        for (int c = 0; c < width; ++c) UNROLLED
        for (int k = 0; k < OUTS; ++k) {
            F sum = sums[k * out_apart + c];
            UNROLLED
            for (int n = 0; n < INS; ++n) sum += factor[k][n] * rows[n * in_apart + c];
            sums[k * out_apart + c] = sum;
        }
    }
    APART void add(int outs, int ins, int width) const {
        constexpr int SIZE = 4;
        for (int a = 0, many; a < outs; a += many) {
            many = outs - a < SIZE ? 1 : SIZE;
            int b = 0;
            for (; b + SIZE <= ins; b += SIZE)
                many > 1 ? add_block<SIZE, SIZE>(a, b, width) : add_block<1, SIZE>(a, b, width);
            for (; b < ins; ++b)
                many > 1 ? add_block<SIZE, 1>(a, b, width) : add_block<1, 1>(a, b, width);
        }
    }
};

enum Kind { BY_ROWS, CELLS, FACES };

// Numbers N, dual ones for tangents.
template <class N, class F, Kind KIND> struct Ordinates {
    static constexpr bool BY_CELLS = KIND != BY_ROWS, HAS_FACES = KIND == FACES;
    static constexpr int KINDS = 1 + IS_DUAL<N>;
    // What an ordinate gives in a cell: the mean of I, or cotangents of what scatters, of its rise,
    // of the depth and of scattering, the last two for coefficients of 1.
    enum { MEAN, SOURCE = 0, RISE, MASS, SCATTERED, OUTPUTS };
    enum { PHI, PSI, ETA, ETA_SLOPE, PASSED, DECAYS };
    // A row of cells, or one cell: the place of its first cell along z, counted from where the team
    // begins, y and x, among cells, and among numbers in rings: in its plane and in that upwind, or
    // downwind.
    struct Row {
        int place[3];
        long long at, light[2], returning[2];
    };

    const Sweep<F>& of;
    const int item, number, color, lane, width;
    const Team team;
    const long long cells, all, row_size, plane_size;
    F *const scratch, *const decays, *const carried, *const source_rows;
    N scale, strength, inflow;

    INLINE Ordinates(int item, const Sweep<F>& of, F* local)
        : of(of),
          item(item),
          number(item / of.lanes / of.together),
          color(of.color + item / of.lanes % of.together),
          lane(item % of.lanes),
          width(BY_CELLS ? 1 : of.width),
          team(((const Team*)of.teams)[of.team + number]),
          cells((long long)of.depth * of.height * of.width),
          all(of.colors * cells),
          row_size(of.width + 2),
          plane_size((of.height + 2) * row_size),
          scratch(BY_CELLS ? local : of.scratch + item * scratch_size()),
          decays(scratch),
          carried(scratch + DECAYS * pitch()),
          source_rows(carried + 2 * pitch()),
          scale(number_of(0)),
          strength(number_of(1)),
          inflow(number_of(2)) {}

    INLINE long long pitch() const { return BY_CELLS ? 1 : of.pitch; }
    // Rows of a team on a processor: `decays`, `carried`, copies of moments, and of each ordinate
    // what scatters along it, its tangent or the cotangent of the mean, and outputs.
    INLINE long long scratch_size() const {
        return (DECAYS + 2 + 2LL * of.count + (2 + OUTPUTS) * of.most) * of.pitch;
    }
    INLINE F* ordinate_row(int kind, int j) const {
        return BY_CELLS ? scratch + DECAYS + 2 + kind
                        : source_rows + (2 * of.count + kind * of.most + j - team.begin) * of.pitch;
    }
    INLINE N number_of(int k) const {
        return readable<N>(of.scales, of.d_scales)[k * of.colors + color];
    }
    INLINE const Ordinate& ordinate(int j) const { return ((const Ordinate*)of.ordinates)[j]; }
    INLINE const Path<F>& path(int j) const { return ((const Path<F>*)of.paths)[j]; }
    INLINE Row row(int z, int y, int x) const {
        const long long plane = team.sense > 0 ? z : of.depth - 1 - z;
        const long long at = (y + 1) * row_size + x + 1, size = KINDS * plane_size;
        const int before = z > 0 ? (z - 1) % of.planes : of.planes - 1;
        return {
            {z, y, x},
            (plane * of.height + y) * of.width + x,
            {z % of.planes * size + at, before * size + at},
            {z % of.back_planes * size + at, (z + 1) % of.back_planes * size + at}};
    }
    // The place of an ordinate and this color in arrays of a launch.
    INLINE long long place(int j) const {
        return (long long)(j - of.first) * of.together + color - of.color;
    }
    INLINE F* ring(F* rings, int planes, int j) const {
        return rings + place(j) * planes * KINDS * plane_size;
    }
    INLINE F* output(int which, int j, const Row& row) const {
        if (BY_CELLS)
            return of.outputs + ((long long)which * of.launched + place(j)) * cells + row.at;
        return ordinate_row(2 + which, j);
    }
    INLINE auto field(const F* values, const F* changes, int channels, const Row& row) const {
        return readable<N>(values, changes) + ((channels > 1 ? color * cells : 0) + row.at);
    }
    template <int POINTS> struct Upwind {
        F weights[POINTS];
        decltype(readable<N>((const F*)0, (const F*)0)) from[POINTS];
        INLINE N operator()(int c) const {
            if constexpr (POINTS == 1)
                return from[0][c];
            else
                return weights[0] * from[0][c] + weights[1] * from[1][c] +
                       (weights[2] * from[2][c] + weights[3] * from[3][c]);
        }
    };
    // Where light comes from, `side` -1, or goes to, 1, of a ring of planes.
    template <int POINTS>
    INLINE Upwind<POINTS> neighbors(const F* ring, const long long* planes, int side, int j) const {
        Upwind<POINTS> points;
        const Ordinate& ordinate = this->ordinate(j);
        UNROLLED
        for (int k = 0; k < POINTS; ++k) {
            const F* const at = ring + planes[ordinate.back[k]] + side * ordinate.shifts[k];
            points.weights[k] = path(j).weights[k];
            points.from[k] = readable<N>(at, at + plane_size);
        }
        return points;
    }

    // Copies a number in a ring to beyond the opposite faces along which the grid is periodic, but
    // for those across which slices lie.
    INLINE void repeat(F* ring, int planes, int j, const Row& row) const {
        const int sizes[3] = {of.depth, of.height, of.width};
        int places[3][3], counts[3];
        for (int a = 0; a < 3; ++a) {
            const int place = row.place[a], last = sizes[a] - 1;
            const bool is_around = of.periodic >> a & 1 && a != ordinate(j).axis;
            counts[a] = 1, places[a][0] = place;
            if (is_around && place == 0) places[a][counts[a]++] = sizes[a];
            if (is_around && place == last) places[a][counts[a]++] = -1;
        }
        const F* const from = ring + row.light[0];
        for (int z = 0; z < counts[0]; ++z)
            for (int y = 0; y < counts[1]; ++y)
                for (int x = 0; x < counts[2]; ++x) {
                    const int plane = (places[0][z] + planes) % planes;
                    F* const to = ring + plane * KINDS * plane_size +
                                  (places[1][y] + 1) * row_size + places[2][x] + 1;
                    for (int k = 0; k < KINDS; ++k) to[k * plane_size] = from[k * plane_size];
                }
    }

    // Sums of moments times `by` [ordinates, count] for a team's ordinates from `begin` to `end`.
    // Rows of moments are copied: far apart they would take each other's places in a cache.
    INLINE void sum_moments(
        int kind, const F* moments, const F* by, const Row& row, int begin, int end) const {
        const F* const from = moments + color * cells + row.at;
        F* const copies = source_rows;
        if constexpr (!BY_CELLS)
            for (int k = 0; k < of.count; ++k) {
                INDEPENDENT
                for (int c = 0; c < of.width; ++c) copies[k * of.pitch + c] = from[k * all + c];
            }
        F* const sums = ordinate_row(kind, begin);
        for (long long c = 0; c < (end - begin) * pitch(); ++c) sums[c] = F(0);
        const Product<F> product = {sums,
                                    pitch(),
                                    BY_CELLS ? from : copies,
                                    BY_CELLS ? all : of.pitch,
                                    by + begin * of.count,
                                    of.count,
                                    1};
        product.add(end - begin, of.count, width);
    }
    // Decay terms in a row, by the path through a cell: ordinates with the same one share them.
    template <bool HAS_SLOPES> INLINE void find_decays(const Row& row, F step) const {
        const long long first = of.extinctions > 1 ? (long long)color * of.depth * of.height : 0;
        const F densest = of.densest[first + row.at / of.width];
        if (value_of(scale) * step * densest < F(0.5))
            find_decays<HAS_SLOPES, true>(row, step);
        else
            find_decays<HAS_SLOPES, false>(row, step);
    }
    template <bool HAS_SLOPES, bool IS_THIN> APART void find_decays(const Row& row, F step) const {
        const F* const e = of.extinction + (of.extinctions > 1 ? color * cells : 0) + row.at;
        const F scale = value_of(this->scale) * step;
        F* const decays = this->decays;
        const long long pitch = this->pitch();
        const int width = this->width;
        INDEPENDENT
        for (int c = 0; c < width; ++c) {
            const Decay<F> by = decay_along<IS_THIN>(scale * e[c]);
            decays[PHI * pitch + c] = by.phi, decays[PSI * pitch + c] = by.psi;
            decays[ETA * pitch + c] = by.eta, decays[PASSED * pitch + c] = by.passed;
            if constexpr (HAS_SLOPES) decays[ETA_SLOPE * pitch + c] = by.eta_slope;
        }
    }

    static INLINE Decay<F> decay_at(const F* decays, long long pitch, int c) {
        return {
            decays[PHI * pitch + c], decays[PSI * pitch + c], decays[ETA * pitch + c],
            decays[ETA_SLOPE * pitch + c], decays[PASSED * pitch + c]};
    }

    // Does `each` row of planes and ordinates, or the cell of this item; or what lies `beyond` the
    // last slice.
    template <bool IS_BACK, bool HAS_SLOPES, class Before, class Each, class After, class Beyond>
    INLINE void go(Before before, Each each, After after, Beyond beyond) const {
        if constexpr (BY_CELLS) {
            const Ordinate& ordinate = this->ordinate(team.begin);
            const int axis = ordinate.axis, sizes[3] = {of.depth, of.height, of.width};
            const int columns = axis == 2 ? of.height : of.width, s = of.begin;
            const int r = lane / columns, c = lane % columns;
            if (s >= sizes[axis] + HAS_FACES || r >= sizes[axis == 0]) return;
            const int t = axis && ordinate.senses[axis] < 0 ? sizes[axis] - 1 - s : s;
            const Row row = axis == 0   ? this->row(t, r, c)
                            : axis == 1 ? this->row(r, t, c)
                                        : this->row(r, c, t);
            if (s == sizes[axis]) return beyond(row, team.begin);
            find_decays<HAS_SLOPES>(row, path(team.begin).step);
            before(row, team.begin, team.end);
            each(row, team.begin);
        } else {
            for (int s = of.begin; s < of.end; ++s)
                for (int turn = 0; turn < 2; ++turn)
                    for (int t = 0; t < of.height; ++t) {
                        const int begin = turn ? team.middle : team.begin;
                        const int end = turn ? team.end : team.middle;
                        if (begin == end) break;
                        const Row row = this->row(
                            IS_BACK ? of.end - 1 - (s - of.begin) : s,
                            bool(turn) != IS_BACK ? of.height - 1 - t : t, 0);
                        before(row, begin, end);
                        F step = F(0);
                        for (int j = begin; j < end; ++j) {
                            if (path(j).step != step)
                                find_decays<HAS_SLOPES>(row, step = path(j).step);
                            each(row, j);
                        }
                        after(row, begin, end);
                    }
        }
    }
    // Adds what ordinates gave in a row, times `by` [ordinates, count], to `sums`.
    INLINE void collect(
        int which, const F* by, int apart, int count, F* sums, const Row& row, int begin,
        int end) const {
        const long long piece = number / 2;
        const Product<F> product = {
            sums + (piece * count * of.colors + color) * cells + row.at,
            all,
            output(which, begin, row),
            of.pitch,
            by + begin * apart,
            1,
            apart};
        product.add(count, end - begin, width);
    }

    // Light through the cells: moments of its mean, unless light alone is kept.
    template <bool KEEPS> INLINE void follow() const {
        go<false, IS_DUAL<N>>(
            [&](const Row& row, int begin, int end) HERE {
                sum_moments(0, of.source, of.values, row, begin, end);
                if constexpr (IS_DUAL<N>) sum_moments(1, of.d_source, of.values, row, begin, end);
            },
            [&](const Row& row, int j) HERE {
                if (!BY_CELLS && ordinate(j).axis == 2) {
                    follow_row<ALONG, 4>(row, j);
                    const int way = ordinate(j).senses[2];
                    F* const to = ring(of.light, of.planes, j) + row.light[0];
                    carry_on<N>(to, to + plane_size, way);
                    if constexpr (!KEEPS) follow_row<WITHIN, 4>(row, j);
                } else if (ordinate(j).count == 1) {
                    follow_row<KEEPS ? AFTER : BOTH, 1>(row, j);
                } else {
                    follow_row<KEEPS ? AFTER : BOTH, 4>(row, j);
                }
                if constexpr (HAS_FACES) repeat(ring(of.light, of.planes, j), of.planes, j, row);
            },
            [&](const Row& row, int begin, int end) HERE {
                if constexpr (!KEEPS)
                    collect(MEAN, of.weighted, of.count, of.count, of.moments, row, begin, end);
            },
            [&](const Row& row, int j) HERE {
                F* const light = ring(of.light, of.planes, j);
                const N arriving = neighbors<4>(light, row.light, -1, j)(0) + entering(row, j)[0];
                light[row.light[0]] = value_of(arriving);
                if constexpr (IS_DUAL<N>) light[row.light[0] + plane_size] = change_of(arriving);
            });
    }
    // Light that enters the cells of a row from outside, besides the inflow.
    INLINE auto entering(const Row& row, int j) const {
        const F* const at = of.entering + place(j) * of.planes * KINDS * plane_size + row.light[0];
        return readable<N>(at, at + plane_size);
    }
    // The result for a row: I where it leaves cells and its mean, or one of them. ALONG: I where
    // it leaves cells, but for what comes from cells of the same row, and which part of that does.
    enum Result { BOTH, AFTER, WITHIN, ALONG };
    template <Result RESULT, int POINTS> APART void follow_row(const Row& row, int j) const {
        const Path<F> path = this->path(j);
        const auto source = readable<N>(ordinate_row(0, j), ordinate_row(1, j));
        const auto e = field(of.extinction, of.d_extinction, of.extinctions, row);
        const auto sc = field(of.scattering, of.d_scattering, of.scatterings, row);
        const auto rises = field(of.gradient, of.d_gradient, of.colors + 1, row);
        F* const light = ring(of.light, of.planes, j);
        auto upwind = neighbors<POINTS>(light, row.light, -1, j);
        const F along = upwind.weights[0];
        if constexpr (RESULT == ALONG) upwind.weights[0] = F(0);
        F *const to = light + row.light[0], *const d_to = to + plane_size;
        F *const mean = output(MEAN, j, row), *const carried = this->carried;
        const N scale = this->scale * path.step, strength = this->strength * path.step;
        const N inflow = this->inflow;
        const long long all = this->all, pitch = this->pitch();
        const int width = this->width;
        const F* const decays = this->decays;
        INDEPENDENT
        for (int c = 0; c < width; ++c) {
            N arriving = upwind(c);
            if constexpr (HAS_FACES) arriving += entering(row, j)[c];
            const N depth = scale * e[c], scatters = strength * sc[c];
            const N rise = path.moved[0] * rises[c] + path.moved[1] * rises[all + c] +
                           path.moved[2] * rises[2 * all + c];
            const Emitted<N> emitted = {scatters * source[c], scatters * rise};
            const Attenuation<N> by = pass_through(decay_at(decays, pitch, c), depth);
            if constexpr (RESULT != WITHIN) {
                const N after = light_after(arriving, emitted, inflow, by);
                to[c] = value_of(after);
                if constexpr (IS_DUAL<N>) d_to[c] = change_of(after);
            }
            if constexpr (RESULT == ALONG) {
                carried[c] = along * value_of(by.passed);
                if constexpr (IS_DUAL<N>) carried[pitch + c] = along * change_of(by.passed);
            }
            if constexpr (RESULT == BOTH || RESULT == WITHIN)
                mean[c] = change_of(light_within(arriving, emitted, inflow, by) + inflow);
        }
    }
    // What comes along a row itself is carried on from cell to cell.
    template <class M> INLINE void carry_on(F* to, F* d_to, int way) const {
        const auto local = readable<M>(to, d_to), by = readable<M>(carried, carried + pitch());
        M x = F(0);
        for (int t = 0; t < width; ++t) {
            const int c = way > 0 ? t : width - 1 - t;
            x = local[c] + by[c] * x;
            to[c] = value_of(x);
            if constexpr (IS_DUAL<M>) d_to[c] = change_of(x);
        }
    }

    // The adjoint: cotangents are gathered from cells downwind.
    INLINE void go_back() const {
        double sum = 0;
        go<true, true>(
            [&](const Row& row, int begin, int end) HERE {
                sum_moments(0, of.source, of.values, row, begin, end);
                sum_moments(1, of.bars, of.weighted, row, begin, end);
            },
            [&](const Row& row, int j) HERE {
                if (!BY_CELLS && ordinate(j).axis == 2) {
                    return_along(row, j);
                    sum += return_row<false, 4>(row, j);
                } else {
                    sum += ordinate(j).count == 1 ? return_row<true, 1>(row, j)
                                                  : return_row<true, 4>(row, j);
                }
                if constexpr (HAS_FACES)
                    repeat(ring(of.returning, of.planes, j), of.planes, j, row);
            },
            [&](const Row& row, int begin, int end) HERE {
                const int apart = sizeof(Path<F>) / sizeof(F);
                collect(SOURCE, of.values, of.count, of.count, of.moments, row, begin, end);
                collect(RISE, of.paths + 1, apart, 3, of.gradient_bar, row, begin, end);
                collect(MASS, of.ones, 1, 1, of.e_bar, row, begin, end);
                collect(SCATTERED, of.ones, 1, 1, of.sc_bar, row, begin, end);
            },
            [&](const Row& row, int j) HERE {
                repeat(ring(of.returning, of.planes, j), of.planes, j, row);
            });
        of.inflow_bar[item] += sum;
    }
    // What returns to the cells of a row, where it does so along the row itself.
    APART void return_along(const Row& row, int j) const {
        F* const returning = ring(of.returning, of.back_planes, j);
        auto downwind = neighbors<4>(returning, row.returning, 1, j);
        const F along = downwind.weights[0], *const bar = ordinate_row(1, j),
                *const decays = this->decays;
        downwind.weights[0] = F(0);
        F* const to = returning + row.returning[0];
        F* const carried = this->carried;
        const long long pitch = this->pitch();
        const int width = this->width;
        INDEPENDENT
        for (int c = 0; c < width; ++c) {
            const F passed = decays[PASSED * pitch + c];
            carried[c] = along * passed;
            to[c] = downwind(c) * passed + bar[c] * decays[PHI * pitch + c];
        }
        carry_on<F>(to, to, -ordinate(j).senses[2]);
    }
    template <bool IS_RETURNING, int POINTS> APART F return_row(const Row& row, int j) const {
        REORDERED
        const Path<F> path = this->path(j);
        const F *const source = ordinate_row(0, j), *const bar = ordinate_row(1, j);
        const F* const e = field(of.extinction, nullptr, of.extinctions, row);
        const F* const sc = field(of.scattering, nullptr, of.scatterings, row);
        const F* const rises = field(of.gradient, nullptr, of.colors + 1, row);
        F* const returning = ring(of.returning, of.back_planes, j);
        const auto upwind = neighbors<POINTS>(ring(of.light, of.planes, j), row.light, -1, j);
        const auto downwind = neighbors<POINTS>(returning, row.returning, 1, j);
        F* const to = returning + row.returning[0];
        F *const source_bar = output(SOURCE, j, row), *const rise_bar = output(RISE, j, row);
        F *const mass_bar = output(MASS, j, row), *const scattered = output(SCATTERED, j, row);
        const F step = path.step, scale = this->scale * step, strength = this->strength * step;
        const F inflow = this->inflow;
        const long long all = this->all, pitch = this->pitch();
        const int width = this->width;
        const F* const decays = this->decays;
        F sum = 0;
        INDEPENDENT
        for (int c = 0; c < width; ++c) {
            const F within_bar = bar[c];
            F arriving = upwind(c), after_bar = downwind(c);
            // Where light leaves the box its cotangent was written before.
            if constexpr (HAS_FACES) arriving += entering(row, j)[c], after_bar += to[c];
            const F depth = scale * e[c], scatters = strength * sc[c], q = source[c];
            const F rise = path.moved[0] * rises[c] + path.moved[1] * rises[all + c] +
                           path.moved[2] * rises[2 * all + c];
            const Emitted<F> emitted = {scatters * q, scatters * rise};
            const Decay<F> decay = decay_at(decays, pitch, c);
            const Attenuation<Dual<F>> by = pass_through(decay, Dual<F>(depth, F(1)));
            const F depth_bar = after_bar * light_after(arriving, emitted, inflow, by).by[0] +
                                within_bar * light_within(arriving, emitted, inflow, by).by[0];
            const F whole_bar = after_bar * by.phi.value + within_bar * by.psi.value;
            const F slope_bar = after_bar * by.rising.value - within_bar * by.eta.value;
            if constexpr (IS_RETURNING)
                to[c] = after_bar * by.passed.value + within_bar * by.phi.value;
            source_bar[c] = whole_bar * scatters;
            rise_bar[c] = slope_bar * scatters;
            mass_bar[c] = depth_bar * step;
            scattered[c] = (whole_bar * q + slope_bar * rise) * step;
            sum += within_bar * by.phi.value - after_bar * by.lost.value;
        }
        return sum;
    }
};

} // namespace ddrecon
