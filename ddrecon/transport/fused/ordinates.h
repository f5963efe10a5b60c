#pragma once
#include "ddrecon/kernels/dual.h"
#include "ddrecon/transport/fused/attenuation.h"
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
// are formed row by row. What leaves by a face across y or x of a periodic grid enters by the
// opposite one: along x in closed form, and along y by laps through the rows of a plane, since
// light that leaves planes is gone after some. Ordinates within planes are swept by cells.
//
// By cells, for a GPU, and where light enters by faces or stays between them: an item is a cell of
// a slice, for one ordinate and color. A launch does one slice of every ordinate. What moments are
// along ordinates is known before, and what ordinates give is summed later: as products of
// matrices. What leaves by a face of a periodic grid enters by the opposite one.

#if IS_GPU
#define APART INLINE
#else
// Compiled apart from what calls it, so that loops have registers to themselves.
#define APART __attribute__((noinline))
#endif

namespace ddrecon {

// Ordinates from `begin` on; those from `middle` to `end` go down in y. `sense` along z: 1 or -1.
// From `around` [up, down] on they go around along y.
struct Team {
    int begin, middle, end, sense, around[2];
};
// An ordinate: the axis across which its slices lie, its senses along z, y and x, and how many
// points upwind it takes light from: one or four, each so many cells upwind along z and so far
// along y and x; and laps around along y.
struct Ordinate {
    int axis, senses[3], count, back[4], shifts[4], laps;
};
// The path through a cell [u], cells moved along z, y, x on it times that, and weights of points.
template <class F> struct Path {
    F step, moved[3], weights[4];
};

// What kernels are given. Arrays are [..., colors, cells]; tangents have d_ before their names.
// What cells emit has moments `source` [count] and rises by `gradient` [3]. `values` and `weighted`
// [ordinates, count] are harmonics times the path through a cell, and times quadrature weights. By
// cells `source` and `bars` [ordinates] are sums of moments times these.
// `light` is I where it leaves cells, and `returning` are cotangents of I where it enters them: for
// each ordinate and color a ring of `planes` or `back_planes` planes with a rim of zeros. So is
// `entering`, what enters cells from outside, null for nothing.
// `outputs` are what ordinates give in each cell, to be summed; by rows `sums` and cotangents are.
// A launch has ordinates from `first` on, teams from `team` on, `together` colors from `color` on,
// and `lanes` items for a team and color. It does planes `begin` to `end`, or the slice `begin`.
template <class F> struct Sweep {
    const int *teams, *ordinates;
    const F *paths, *values, *weighted, *extinction, *gradient, *source;
    const F *d_extinction, *d_gradient, *d_source, *bars, *entering;
    F *light, *returning, *scratch, *outputs, *sums, *gradient_bar, *extinction_bar;
    int depth, height, width, periodic, count, colors, planes, back_planes;
    int pitch, room, first, launched, team, color, together, lanes, begin, end;
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

// Numbers N, dual ones for tangents.
template <class N, class F, bool BY_CELLS> struct Ordinates {
    static constexpr int KINDS = 1 + IS_DUAL<N>;
    // Rows of scratch: decay terms in a row, and what is carried on along it. Behind these are
    // copies of moments, and two rows for each ordinate.
    enum { PHI, PSI, ETA, ETA_SLOPE, PASSED, CARRIED, D_CARRIED, ROWS };
    // Rows of an ordinate: what cells emit along it, and the change of that or the cotangent of the
    // mean. Its outputs replace them: the mean, or cotangents of what is emitted and of its rise.
    // By cells a third output is the cotangent of extinction.
    enum { EMITTED, CHANGE, MEAN_BAR = 1, MEAN = 0, SUM_BAR = 0, RISE_BAR, EXTINCTION_BAR };
    static constexpr int CELL = ROWS + 2;
    // What goes around along a row is followed for 2^DOUBLINGS periods.
    static constexpr int DOUBLINGS = 10;
    static constexpr F ROUNDING = sizeof(F) == 4 ? F(1.1920929e-7) : F(2.220446049250313e-16);
    // Numbers in a line of a cache.
    static constexpr int LINE = 64 / sizeof(F);
    // Where a row of cells, or a cell, begins: among cells, and among numbers in rings, in its
    // plane and in that upwind, or downwind.
    struct Row {
        long long at, light[2], returning[2];
    };

    const Sweep<F>& of;
    const int number, color, lane, width;
    const Team team;
    const long long cells, all, row_size, plane_size, pitch;
    F *const scratch, *const rows;

    INLINE Ordinates(int item, const Sweep<F>& of, F* local)
        : of(of),
          number(item / of.lanes / of.together),
          color(of.color + item / of.lanes % of.together),
          lane(item % of.lanes),
          width(BY_CELLS ? 1 : of.width),
          team(((const Team*)of.teams)[of.team + number]),
          cells((long long)of.depth * of.height * of.width),
          all(of.colors * cells),
          row_size(of.width + 2),
          plane_size((of.height + 2) * row_size),
          pitch(BY_CELLS ? 1 : of.pitch),
          scratch(BY_CELLS ? local : of.scratch + (long long)item * of.room * pitch),
          rows(scratch + (BY_CELLS ? +ROWS : ROWS + of.count) * pitch) {}

    INLINE const Ordinate& ordinate(int j) const { return ((const Ordinate*)of.ordinates)[j]; }
    INLINE const Path<F>& path(int j) const { return ((const Path<F>*)of.paths)[j]; }
    INLINE F* ordinate_row(int kind, int j) const {
        return rows + (2 * (j - team.begin) + kind) * pitch;
    }
    // The row `y` of plane `z`, counted from where the team begins. Rings hold the last planes.
    INLINE Row row(int z, int y) const {
        const long long plane = team.sense > 0 ? z : of.depth - 1 - z;
        const long long at = (y + 1) * row_size + 1, size = KINDS * plane_size;
        const int before = z > 0 ? (z - 1) % of.planes : of.planes - 1;
        return {
            (plane * of.height + y) * of.width,
            {z % of.planes * size + at, before * size + at},
            {z % of.back_planes * size + at, (z + 1) % of.back_planes * size + at}};
    }
    // The cell at a `place`. Rings hold all planes, and one beyond either end.
    INLINE Row cell(const int* place, int sense) const {
        const long long size = KINDS * plane_size, step = sense * size;
        const long long at = (place[0] + 1) * size + (place[1] + 1) * row_size + place[2] + 1;
        const long long row = (long long)place[0] * of.height + place[1];
        return {row * of.width + place[2], {at, at - step}, {at, at + step}};
    }
    // The place of an ordinate and this color in arrays of a launch.
    INLINE long long place(int j) const {
        return (long long)(j - of.first) * of.together + color - of.color;
    }
    INLINE F* ring(F* rings, int planes, int j) const {
        return rings + place(j) * planes * KINDS * plane_size;
    }
    INLINE F* output(int which, int j, const Row& row) const {
        if constexpr (BY_CELLS)
            return of.outputs + ((long long)which * of.launched + place(j)) * cells + row.at;
        if (which == EXTINCTION_BAR) return sum_of(of.extinction_bar, 1, row);
        return ordinate_row(which, j);
    }
    // Sums of this color over the ordinates of a piece, which is two teams.
    INLINE F* sum_of(F* sums, int count, const Row& row) const {
        return sums + ((long long)(number / 2) * count * of.colors + color) * cells + row.at;
    }
    INLINE auto field(const F* values, const F* changes, const Row& row) const {
        return readable<N>(values, changes) + (color * cells + row.at);
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
    // Light that enters the cells of a row from outside.
    INLINE N entering(const Row& row, int j) const {
        if (!of.entering) return N(F(0));
        const F* const at = of.entering + place(j) * of.planes * KINDS * plane_size + row.light[0];
        return readable<N>(at, at + plane_size)[0];
    }

    // Copies a number in a ring to beyond the opposite faces along which the grid is periodic, but
    // for those across which slices lie.
    INLINE void repeat(F* ring, int axis, const int* place, const Row& row) const {
        const long long sizes[3] = {of.depth, of.height, of.width};
        int first[3], last[3];
        for (int a = 0; a < 3; ++a) {
            const bool is_around = of.periodic >> a & 1 && a != axis;
            first[a] = is_around && place[a] == sizes[a] - 1 ? -1 : 0;
            last[a] = is_around && place[a] == 0 ? 1 : 0;
        }
        const F* const from = ring + row.light[0];
        for (int z = first[0]; z <= last[0]; ++z)
            for (int y = first[1]; y <= last[1]; ++y)
                for (int x = first[2]; x <= last[2]; ++x) {
                    const long long planes = KINDS * z * sizes[0] * plane_size;
                    F* const to =
                        ring + row.light[0] + planes + y * sizes[1] * row_size + x * sizes[2];
                    for (int k = 0; k < KINDS; ++k) to[k * plane_size] = from[k * plane_size];
                }
    }

    // Sums of moments times `by` [ordinates, count], for ordinates from `begin` to `end`.
    // Rows of moments are copied: far apart they would take each other's places in a cache.
    // By cells sums are what was given.
    INLINE void sum_moments(
        int kind, const F* moments, const F* by, const Row& row, int begin, int end) const {
        if constexpr (BY_CELLS) {
            *ordinate_row(kind, begin) = moments[place(begin) * cells + row.at];
            return;
        }
        const F* const from = moments + color * cells + row.at;
        F* const copies = scratch + ROWS * pitch;
        for (int k = 0; k < of.count; ++k) {
            INDEPENDENT
            for (int c = 0; c < width; ++c) copies[k * pitch + c] = from[k * all + c];
        }
        for (int j = begin; j < end; ++j)
            for (int c = 0; c < width; ++c) ordinate_row(kind, j)[c] = F(0);
        F* const sums = ordinate_row(kind, begin);
        by += begin * of.count;
        Product<F>{sums, 2 * pitch, copies, pitch, by, of.count, 1}.add(
            end - begin, of.count, width);
    }
    // Adds what ordinates gave in a row, times `by` [ordinates, apart], to `count` of `sums`.
    INLINE void collect(
        int which, const F* by, int apart, int count, F* sums, const Row& row, int begin,
        int end) const {
        const F* const from = ordinate_row(which, begin);
        by += begin * apart;
        Product<F>{sum_of(sums, count, row), all, from, 2 * pitch, by, 1, apart}.add(
            count, end - begin, width);
    }
    // Decay terms in a row, by the path through a cell: ordinates with the same one share them.
    template <bool HAS_SLOPES> APART void find_decays(const Row& row, F step) const {
        const F* const e = of.extinction + color * cells + row.at;
        F* const decays = scratch;
        const long long pitch = this->pitch;
        const int width = BY_CELLS ? 1 : this->width; // A constant: no loop is left.
        INDEPENDENT
        for (int c = 0; c < width; ++c) {
            const Decay<F> by = decay_along(step * e[c]);
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

    // Follows light through the cells, for its moments or for itself alone; or returns cotangents.
    // RETURN is for cotangents of what enters cells alone.
    enum Pass { MOMENTS, LIGHT, BACK, RETURN };
    template <Pass PASS> static constexpr bool HAS_SLOPES = PASS == BACK || IS_DUAL<N>;
    template <Pass PASS> INLINE void run() const {
        if constexpr (BY_CELLS)
            run_cell<PASS>(team.begin);
        else
            for (int s = of.begin; s < of.end; ++s) {
                const bool is_back = PASS == BACK;
                const int plane = is_back ? of.end - 1 - (s - of.begin) : s;
                run_plane<PASS>(plane, !is_back, team.begin, team.around[0], team.middle);
                run_plane<PASS>(plane, is_back, team.middle, team.around[1], team.end);
            }
    }
    template <Pass PASS>
    INLINE void run_plane(int plane, bool is_up, int begin, int around, int end) const {
        if (around < end) go_around<PASS == BACK ? RETURN : LIGHT>(plane, is_up, around, end);
        run_rows<PASS>(plane, is_up, begin, end);
        if (of.periodic & 2)
            for (int j = begin; j < end; ++j) {
                wrap_rows(plane_of<PASS>(plane, j), true);
                wrap_rows(plane_of<PASS>(plane, j), false);
            }
    }
    template <Pass PASS> INLINE void run_rows(int plane, bool is_up, int begin, int end) const {
        if (begin == end) return;
        for (int y = 0; y < of.height; ++y)
            run_row<PASS>(row(plane, is_up ? y : of.height - 1 - y), is_up, begin, end);
    }
    // A plane of the ring that a pass writes.
    template <Pass PASS> INLINE F* plane_of(int plane, int j) const {
        const Row first = row(plane, 0);
        return PASS == BACK || PASS == RETURN
                   ? ring(of.returning, of.back_planes, j) + first.returning[0]
                   : ring(of.light, of.planes, j) + first.light[0];
    }
    // Finds what enters a plane along y after periods, of ordinates whose light comes from cells of
    // the same plane: laps begin with nothing, and end by their number or where nothing changes.
    template <Pass PASS> APART void go_around(int plane, bool is_up, int begin, int end) const {
        int laps = 0;
        for (int j = begin; j < end; ++j) {
            F* const rim = plane_of<PASS>(plane, j) + (is_up ? -1 : of.height) * row_size - 1;
            for (int k = 0; k < KINDS; ++k)
                for (int c = 0; c < row_size; ++c) rim[k * plane_size + c] = F(0);
            laps = ordinate(j).laps > laps ? ordinate(j).laps : laps;
        }
        bool changes = true;
        for (int lap = 0; lap < laps && changes; ++lap) {
            run_rows<PASS>(plane, is_up, begin, end);
            changes = false;
            for (int j = begin; j < end; ++j) changes |= wrap_rows(plane_of<PASS>(plane, j), is_up);
        }
    }
    // Copies the ends of a row, where the grid is periodic along it, to beyond the opposite ones.
    INLINE void wrap_columns(F* row) const {
        if (BY_CELLS || !(of.periodic & 4)) return;
        for (int k = 0; k < KINDS; ++k, row += plane_size)
            row[-1] = row[width - 1], row[width] = row[0];
    }
    // Copies the last row of a plane to before the first, and says whether that changes it.
    INLINE bool wrap_rows(F* plane, bool is_up) const {
        const long long last = (is_up ? of.height - 1 : 0) * row_size - 1;
        const long long rim = (is_up ? -1 : of.height) * row_size - 1;
        bool changes = false;
        for (int k = 0; k < KINDS; ++k, plane += plane_size) {
            F change = F(0), size = F(0);
            for (int c = 0; c < row_size; ++c) {
                const F before = plane[rim + c], after = plane[last + c];
                const F moved = after < before ? before - after : after - before;
                const F length = after < F(0) ? -after : after;
                change = moved > change ? moved : change;
                size = length > size ? length : size;
                plane[rim + c] = after;
            }
            changes |= change > ROUNDING * size;
        }
        return changes;
    }
    // Rows of `count` numbers of each cell, asked for before they are needed. Not long before: so
    // far apart, they take each other's places in a cache.
    INLINE void prefetch(const F* numbers, int count) const {
        for (int k = 0; k < count; ++k)
            for (int c = 0; c < width; c += LINE) __builtin_prefetch(numbers + k * all + c);
    }
    template <Pass PASS> INLINE void run_row(const Row& row, bool is_up, int begin, int end) const {
        const long long at = color * cells + row.at, next = at + (is_up ? width : -width);
        prefetch(of.extinction + at, 1);
        if (PASS != RETURN) prefetch(of.gradient + at, 3);
        sum_sources<PASS>(row, begin, end);
        if (PASS != RETURN) prefetch(of.source + next, of.count);
        if (PASS == MOMENTS || PASS == BACK) prefetch(sum_of(of.sums, of.count, row), of.count);
        if (PASS == BACK) {
            prefetch(of.bars + next, of.count);
            prefetch(sum_of(of.gradient_bar, 3, row), 3);
            prefetch(sum_of(of.extinction_bar, 1, row), 1);
        }
        F step = F(0);
        for (int j = begin; j < end; ++j) {
            if (path(j).step != step) find_decays<HAS_SLOPES<PASS>>(row, step = path(j).step);
            run_ordinate<PASS>(row, j);
        }
        if constexpr (PASS == MOMENTS)
            collect(MEAN, of.weighted, of.count, of.count, of.sums, row, begin, end);
        if constexpr (PASS == BACK) {
            collect(SUM_BAR, of.values, of.count, of.count, of.sums, row, begin, end);
            const int apart = sizeof(Path<F>) / sizeof(F);
            collect(RISE_BAR, of.paths + 1, apart, 3, of.gradient_bar, row, begin, end);
        }
    }
    template <Pass PASS> INLINE void run_cell(int j) const {
        const Ordinate& ordinate = this->ordinate(j);
        const int axis = ordinate.axis, sizes[3] = {of.depth, of.height, of.width};
        const int columns = sizes[axis == 2 ? 1 : 2], r = lane / columns, c = lane % columns;
        const int s = of.begin, end = sizes[axis];
        if (s >= end + (of.entering != nullptr) || r >= sizes[axis == 0]) return;
        int place[3] = {r, axis == 2 ? c : r, c};
        place[axis] = ordinate.senses[axis] < 0 ? end - 1 - s : s;
        const Row row = cell(place, ordinate.senses[0]);
        F* const light = ring(of.light, of.planes, j);
        if (s < end) {
            sum_sources<PASS>(row, j, j + 1);
            find_decays<HAS_SLOPES<PASS>>(row, path(j).step);
            run_ordinate<PASS>(row, j);
            if (PASS != BACK) repeat(light, axis, place, row);
        } else if (PASS != BACK) {
            // Light that leaves the last slice lies in the place of cells behind it.
            const N arriving = neighbors<4>(light, row.light, -1, j)(0) + entering(row, j);
            light[row.light[0]] = value_of(arriving);
            if constexpr (IS_DUAL<N>) light[row.light[0] + plane_size] = change_of(arriving);
        }
        if (PASS == BACK) repeat(ring(of.returning, of.planes, j), axis, place, row);
    }
    template <Pass PASS> INLINE void sum_sources(const Row& row, int begin, int end) const {
        constexpr bool IS_BACK = PASS == BACK || PASS == RETURN;
        if constexpr (PASS != RETURN) sum_moments(EMITTED, of.source, of.values, row, begin, end);
        if constexpr (IS_DUAL<N>) sum_moments(CHANGE, of.d_source, of.values, row, begin, end);
        if constexpr (IS_BACK) sum_moments(MEAN_BAR, of.bars, of.weighted, row, begin, end);
    }
    template <Pass PASS> INLINE void run_ordinate(const Row& row, int j) const {
        const bool is_along = !BY_CELLS && ordinate(j).axis == 2,
                   is_single = ordinate(j).count == 1;
        if constexpr (PASS == RETURN) {
            is_single ? return_light<1>(row, j) : return_light<4>(row, j);
        } else if constexpr (PASS == BACK) {
            if (is_along)
                return_light<4>(row, j), return_row<false, 4>(row, j);
            else
                is_single ? return_row<true, 1>(row, j) : return_row<true, 4>(row, j);
            wrap_columns(ring(of.returning, of.back_planes, j) + row.returning[0]);
        } else {
            constexpr Result RESULT = PASS == LIGHT ? AFTER : BOTH;
            F* const to = ring(of.light, of.planes, j) + row.light[0];
            if (is_along) {
                follow_row<ALONG, 4>(row, j);
                carry_on<N>(to, to + plane_size, ordinate(j).senses[2]);
            } else {
                is_single ? follow_row<RESULT, 1>(row, j) : follow_row<RESULT, 4>(row, j);
            }
            wrap_columns(to);
            if constexpr (PASS == MOMENTS)
                if (is_along) follow_row<WITHIN, 4>(row, j);
        }
    }

    // The result for a row: I where it leaves cells and its mean, or one of them. ALONG: I where
    // it leaves cells, but for what comes from cells of the same row, and which part of that does.
    enum Result { BOTH, AFTER, WITHIN, ALONG };
    template <Result RESULT, int POINTS> APART void follow_row(const Row& row, int j) const {
        const Path<F> path = this->path(j);
        const auto source = readable<N>(ordinate_row(EMITTED, j), ordinate_row(CHANGE, j));
        const auto e = field(of.extinction, of.d_extinction, row);
        const auto rises = field(of.gradient, of.d_gradient, row);
        F* const light = ring(of.light, of.planes, j);
        auto upwind = neighbors<POINTS>(light, row.light, -1, j);
        const F along = upwind.weights[0];
        if constexpr (RESULT == ALONG) upwind.weights[0] = F(0);
        F *const to = light + row.light[0], *const d_to = to + plane_size;
        F *const mean = output(MEAN, j, row), *const decays = scratch;
        F *const carried = scratch + CARRIED * pitch, *const d_carried = carried + pitch;
        const long long all = this->all, pitch = this->pitch;
        const int width = BY_CELLS ? 1 : this->width;
        INDEPENDENT
        for (int c = 0; c < width; ++c) {
            N arriving = upwind(c);
            if constexpr (BY_CELLS) arriving += entering(row, j);
            const N rise = path.moved[0] * rises[c] + path.moved[1] * rises[all + c] +
                           path.moved[2] * rises[2 * all + c];
            const Emitted<N> emitted = {source[c], rise};
            const Attenuation<N> by = attenuate<F, N>(decay_at(decays, pitch, c), path.step * e[c]);
            if constexpr (RESULT != WITHIN) {
                const N after = light_after(arriving, emitted, by);
                to[c] = value_of(after);
                if constexpr (IS_DUAL<N>) d_to[c] = change_of(after);
            }
            if constexpr (RESULT == ALONG) {
                carried[c] = along * value_of(by.passed);
                if constexpr (IS_DUAL<N>) d_carried[c] = along * change_of(by.passed);
            }
            if constexpr (RESULT == BOTH || RESULT == WITHIN)
                mean[c] = change_of(light_within(arriving, emitted, by));
        }
    }
    // What comes along a row itself is carried on from cell to cell.
    template <class M> INLINE void carry_on(F* to, F* d_to, int sense) const {
        const F* const carried = scratch + CARRIED * pitch;
        const auto local = readable<M>(to, d_to), by = readable<M>(carried, carried + pitch);
        M x = F(0);
        if (of.periodic & 4) {
            M share = F(1);
            for (int t = 0; t < width; ++t) {
                const int c = sense > 0 ? t : width - 1 - t;
                x = local[c] + by[c] * x;
                share = share * by[c];
            }
            for (int n = 0; n < DOUBLINGS; ++n) x = x + share * x, share = share * share;
        }
        for (int t = 0; t < width; ++t) {
            const int c = sense > 0 ? t : width - 1 - t;
            x = local[c] + by[c] * x;
            to[c] = value_of(x);
            if constexpr (IS_DUAL<M>) d_to[c] = change_of(x);
        }
    }

    // Cotangents of what enters the cells of a row, gathered from cells downwind; some may lie in
    // the row itself.
    template <int POINTS> APART void return_light(const Row& row, int j) const {
        F* const returning = ring(of.returning, of.back_planes, j);
        auto downwind = neighbors<POINTS>(returning, row.returning, 1, j);
        const F along = downwind.weights[0], *const bar = ordinate_row(MEAN_BAR, j);
        const bool is_along = ordinate(j).axis == 2;
        if (is_along) downwind.weights[0] = F(0);
        F *const to = returning + row.returning[0], *const decays = scratch;
        const long long pitch = this->pitch;
        const int width = BY_CELLS ? 1 : this->width;
        INDEPENDENT
        for (int c = 0; c < width; ++c) {
            const F passed = decays[PASSED * pitch + c];
            decays[CARRIED * pitch + c] = along * passed;
            to[c] = downwind(c) * passed + bar[c] * decays[PHI * pitch + c];
        }
        if (is_along) carry_on<F>(to, to, -ordinate(j).senses[2]);
        wrap_columns(to);
    }
    // The adjoint of `follow_row`; it IS_RETURNING if `return_light` has not.
    template <bool IS_RETURNING, int POINTS> APART void return_row(const Row& row, int j) const {
        const Path<F> path = this->path(j);
        const F *const source = ordinate_row(EMITTED, j), *const bar = ordinate_row(MEAN_BAR, j);
        const F* const e = field(of.extinction, nullptr, row);
        const F* const rises = field(of.gradient, nullptr, row);
        F* const returning = ring(of.returning, of.back_planes, j);
        const auto upwind = neighbors<POINTS>(ring(of.light, of.planes, j), row.light, -1, j);
        const auto downwind = neighbors<POINTS>(returning, row.returning, 1, j);
        F *const to = returning + row.returning[0], *const e_bar = output(EXTINCTION_BAR, j, row);
        F *const sum_bar = output(SUM_BAR, j, row), *const rise_bar = output(RISE_BAR, j, row);
        const long long all = this->all, pitch = this->pitch;
        const int width = BY_CELLS ? 1 : this->width;
        const F* const decays = scratch;
        INDEPENDENT
        for (int c = 0; c < width; ++c) {
            const F within_bar = bar[c];
            F arriving = upwind(c), after_bar = downwind(c);
            // Where light leaves the box its cotangent was written before.
            if constexpr (BY_CELLS) arriving += entering(row, j), after_bar += to[c];
            const F rise = path.moved[0] * rises[c] + path.moved[1] * rises[all + c] +
                           path.moved[2] * rises[2 * all + c];
            const Emitted<F> emitted = {source[c], rise};
            const Dual<F> depth(path.step * e[c], F(1));
            const Attenuation<Dual<F>> by = attenuate(decay_at(decays, pitch, c), depth);
            const F depth_bar = after_bar * light_after(arriving, emitted, by).by[0] +
                                within_bar * light_within(arriving, emitted, by).by[0];
            if constexpr (IS_RETURNING)
                to[c] = after_bar * by.passed.value + within_bar * by.phi.value;
            sum_bar[c] = after_bar * by.phi.value + within_bar * by.psi.value;
            rise_bar[c] = after_bar * by.rising.value - within_bar * by.eta.value;
            e_bar[c] = (BY_CELLS ? F(0) : e_bar[c]) + depth_bar * path.step;
        }
    }
};

} // namespace ddrecon
