#pragma once
#include "ddrecon/transport/fused/moments.h"
// Rows of cells along which radiance is followed (E2.9, E2.10).
//
// A lane goes through the slices across z in the way that its light takes, s counting them, and in
// each through the rows, t counting them, twice: up in y with those directions that do, and down
// with the others. What scatters in a slice is found before, and moments after. Light comes to a
// cell from up to four, which lie in this slice or the one before, in this row or the one before:
// wherever a direction goes, they were done already. Of a row and a direction there are two lines
// of numbers: OWN, what scatters along it, which becomes the mean of I in each cell, and LIGHT, I
// where it leaves cells, both less the light from outside; of tangents their changes as well. Lines
// of the last slice are kept, each in the place of one that no cell needs any more. I before each
// slab of slices is saved: for the adjoint, light goes through a slab once more, and lines of all
// its slices are kept, OWN as what scatters.
//
// Behind each row there are at least two cells that hold what is beyond its ends. Where there is no
// medium, light is only moved: that is decided for stretches of a row.

namespace ddrecon {

// Numbers N; moments to DEGREE; whether extinction and scattering have the same field, and whether
// lines of all slices are kept.
template <class N, class F, int DEGREE, bool SHARES_FIELD, bool KEEPS> struct Rows {
    static constexpr bool IS_CHANGED = sizeof(N) > sizeof(F);
    static constexpr int COUNT = Order<DEGREE>::COUNT, LINES = IS_CHANGED ? 4 : 2;
    enum { OWN, LIGHT };

    // A row of cells: its slice and its turn on the way in y, where it is among cells, which of
    // them have matter, and the depth of a unit length in the densest.
    struct Here {
        int s, t, y_way, from, to;
        long long at;
        F deepest;
    };
    // Lines where light comes from to a row, of the chunk's first direction: in this slice or the
    // one before, in this row or the one before. Beyond the faces of the box there is no I.
    struct Before {
        Line<N> light[4];
        bool is_inside[4];
    };
    // Cells of a row and a direction: what scatters along it, by how much q rises from cell to
    // cell along z, y and x, fields, and what comes from the cells before.
    template <int POINTS> struct Ways {
        Line<N> own, gradient[3], e, sc, from[POINTS];
        F step, moved[3], part[POINTS];
        INLINE N rise(int c) const {
            return moved[0] * gradient[0][c] + moved[1] * gradient[1][c] +
                   moved[2] * gradient[2][c];
        }
    };

    const Sweep<F>& of;
    const Job& job;
    const Chunk& chunk;
    const long long plane, cells, all, stride;
    F *const scratch, *const empty, *const lines;
    const Line<N> e_cells, sc_cells, gradients;
    N scale, strength, inflow;
    int slice_from = 0;

    INLINE Rows(const Sweep<F>& of, const Job& job)
        : of(of),
          job(job),
          chunk(job.chunk),
          plane((long long)of.height * of.width),
          cells(of.depth * plane),
          all(of.colors * cells),
          stride((long long)LINES * of.most * of.pitch),
          scratch(of.scratch + (long long)job.lane * of.scratch_rows * of.pitch),
          empty(scratch + of.margin),
          lines(
              of.lines +
              job.lane *
                  ((KEEPS ? (of.slab + 1LL) * of.height : of.height + 2) * stride + of.margin) +
              of.margin),
          e_cells(field(of.extinction, of.extinction_channels)),
          sc_cells(field(of.scattering, of.scattering_channels)),
          gradients(line_at<N>(of.gradient + job.color * cells, of.d_gradient - of.gradient)),
          scale(number(0)),
          strength(number(1)),
          inflow(number(2)) {}

    INLINE Line<N> field(const F* of_all, int channels) const {
        const long long own = channels > 1 ? job.color * cells : 0;
        return line_at<N>(of_all + own, channels * cells);
    }
    INLINE N number(int which) const {
        const int at = which * of.colors + job.color;
        if constexpr (IS_CHANGED)
            return N(of.scales[at], of.d_scales[at]);
        else
            return of.scales[at];
    }
    // The first rows are empty.
    INLINE F* scratch_row(int i) const { return scratch + (2LL + i) * of.pitch; }
    INLINE Line<N> line(int s, int t, int which, int j) const {
        const long long place = KEEPS ? (s - slice_from + 1LL) * of.height + t
                                      : (t + 2LL * (of.depth - s)) % (of.height + 2);
        const F* at = lines + place * stride + (LINES * j + which) * (long long)of.pitch;
        return line_at<N>(at, 2LL * of.pitch);
    }
    // Slabs of slices begin anew in the middle, where the ways meet; of those but the first I is
    // saved.
    INLINE int slab_of(int s) const {
        return s - (s < job.to_middle ? s : s - job.to_middle) % of.slab;
    }
    INLINE F* saved_row(int s, int t, int direction) const {
        const int before = s < job.to_middle ? 0 : (job.to_middle + of.slab - 1) / of.slab;
        const int number = before + (s - (before ? job.to_middle : 0)) / of.slab - 1;
        const long long own = job.color * (long long)of.directions + direction;
        return of.saved + ((own * of.slabs + number) * of.height + t) * of.width;
    }

    // Directions that go through a row on its way in y: from one of the chunk to another.
    INLINE int first(const Here& here) const { return here.y_way > 0 ? 0 : chunk.ups; }
    INLINE int last(const Here& here) const { return here.y_way > 0 ? chunk.ups : chunk.members; }
    // All of a row, of which `ups` and `downs` have these lines, so far `apart`.
    INLINE Units<F> units_of(F* ups, F* downs, long long apart) const {
        const int* places = of.units + 4 * chunk.first_unit;
        return {places, chunk.units, chunk.ups, {ups, downs}, scratch_row(5), apart, of.pitch};
    }
    INLINE Units<F> units_at(const Here& here, bool are_changes) const {
        const Line<N> ups = line(here.s, here.t, OWN, 0);
        const Line<N> downs = line(here.s, of.height - 1 - here.t, OWN, 0);
        const long long apart = (long long)LINES * of.pitch;
        if constexpr (IS_CHANGED)
            if (are_changes) return units_of(ups.change, downs.change, apart);
        return units_of(ups.at, downs.at, apart);
    }
    INLINE const F* matrix(int which) const {
        return of.matrices + chunk.matrices + which * COUNT * chunk.units;
    }
    INLINE Here place(int s, int t, int y_way = 1) const {
        const int k = job.way > 0 ? s : of.depth - 1 - s;
        const int r = y_way > 0 ? t : of.height - 1 - t, row = k * of.height + r;
        const int* range = of.ranges + 2 * row;
        const long long at = row * (long long)of.width;
        return {s, t, y_way, range[0], range[1], at, value_of(scale) * of.densest[row]};
    }
    INLINE Before find_before(const Here& here) const {
        Before found;
        for (int i = 0; i < 4; ++i) {
            const int s = here.s - i / 2, t = here.t - i % 2;
            found.is_inside[i] = s >= 0 && t >= 0;
            if (found.is_inside[i]) found.light[i] = line(s, t, LIGHT, 0);
        }
        return found;
    }
    INLINE const Course& course(int j) const {
        return ((const Course*)of.courses)[chunk.begin + j];
    }
    template <int POINTS>
    INLINE Ways<POINTS> find_ways(const Here& here, const Before& before, int j) const {
        Ways<POINTS> found;
        const Course& own = course(j);
        const Parts<F>& parts = ((const Parts<F>*)of.parts)[chunk.begin + j];
        found.step = parts.step;
        found.own = line(here.s, here.t, OWN, j);
        found.e = e_cells + here.at;
        found.sc = sc_cells + here.at;
        UNROLLED
        for (int a = 0; a < 3; ++a) {
            found.moved[a] = parts.moved[a];
            found.gradient[a] = gradients + (a * all + here.at);
        }
        UNROLLED
        for (int i = 0; i < POINTS; ++i) {
            const int *point = own.points[i], place = 2 * point[0] + point[1];
            const long long shift = point[2] * own.x_way;
            found.part[i] = parts.part[i];
            found.from[i] = before.is_inside[place]
                                ? before.light[place] + ((long long)LINES * j * of.pitch - shift)
                                : nothing() + -shift;
        }
        return found;
    }
    INLINE Line<N> nothing() const { return line_at<N>(empty, 0); }

    // What scatters along each direction of a row t up in y, from sums of the moments of what was
    // found, is known and is given (E2.10).
    INLINE const F* row_of(const F* part, long long at) const { return part ? part + at : empty; }
    INLINE void find_scattering(const Here& here, int from, int to) const {
        const long long at = job.color * cells + here.at;
        Sums<F, COUNT, 2> sums;
        for (int i = 0; i < COUNT; ++i) {
            const int k = of.order[i], own = k * of.colors + job.color;
            sums.rows[i][0] = row_of(moment_of(of.light, of.light_low, k, all), at);
            sums.rows[i][1] = row_of(moment_of(of.source, of.source_low, k, all), at);
            sums.by[i][0] = of.factors[own], sums.by[i][1] = F(1);
        }
        to_directions<DEGREE>(matrix(0), sums, units_at(here, false), of.width, from, to);
        if constexpr (IS_CHANGED) {
            Sums<F, COUNT, 3> changes;
            for (int i = 0; i < COUNT; ++i) {
                const int k = of.order[i], own = k * of.colors + job.color;
                const F* const* const lights[3] = {of.d_source, of.d_light, of.light};
                const int lows[3] = {of.source_low, of.light_low, of.light_low};
                const F by[3] = {F(1), of.factors[own], of.d_factors[own]};
                for (int n = 0; n < 3; ++n) {
                    changes.rows[i][n] = row_of(moment_of(lights[n], lows[n], k, all), at);
                    changes.by[i][n] = by[n];
                }
            }
            to_directions<DEGREE>(matrix(0), changes, units_at(here, true), of.width, from, to);
        }
    }

    // Light through the slices from `slice_from` on.
    INLINE void follow(int slice_from, int slice_to) {
        this->slice_from = slice_from;
        for (int s = slice_from - (KEEPS && slice_from > 0); s < slice_to; ++s) {
            for (int t = 0; t < of.height; ++t) {
                const Here here = place(s, t);
                find_scattering(here, KEEPS ? 0 : here.from, KEEPS ? of.width : here.to);
                follow_row(here);
            }
            for (int t = 0; t < of.height; ++t) {
                follow_row(place(s, t, -1));
                if constexpr (!KEEPS) add_moments(place(s, of.height - 1 - t));
            }
        }
    }
    INLINE void follow_row(const Here& here) const {
        const int width = of.width;
        const Before before = find_before(here);
        for (int j = first(here); j < last(here); ++j) {
            const Course& own = course(j);
            const Line<N> light = line(here.s, here.t, LIGHT, j);
            light.put(-1, N(F(0)));
            light.put(width, N(F(0)));
            if (KEEPS && here.s < slice_from) {
                const F* row = saved_row(here.s + 1, here.t, chunk.begin + j);
                for (int c = 0; c < width; ++c) light.at[c] = row[c];
                continue;
            }
            if (own.count == 1)
                follow_direction<1>(here, before, light, j);
            else
                follow_direction<4>(here, before, light, j);
            if (!KEEPS && of.saved && here.s + 1 < of.depth && slab_of(here.s + 1) == here.s + 1) {
                F* row = saved_row(here.s + 1, here.t, chunk.begin + j);
                for (int c = 0; c < width; ++c) row[c] = light.at[c];
            }
        }
    }
    template <int POINTS> INLINE void follow_direction(
        const Here& here, const Before& before, const Line<N>& light, int j) const {
        Ways<POINTS> ways = find_ways<POINTS>(here, before, j);
        const Course& own = course(j);
        if (!own.is_along) {
            follow_ways<false>(here, ways, light);
            return;
        }
        // What comes along the row itself is carried on cell by cell.
        UNROLLED
        for (int i = 0; i < POINTS; ++i)
            if (!own.points[i][0] && !own.points[i][1]) ways.from[i] = nothing();
        follow_ways<true>(here, ways, light);
        const Line<N> carried = line_at<N>(scratch_row(0), of.pitch);
        const Line<N> within = line_at<N>(scratch_row(2), of.pitch);
        const int way = own.x_way, width = of.width;
        carry_on(light.at, carried.at, way, width);
        if constexpr (IS_CHANGED) {
            INDEPENDENT
            for (int c = 0; c < width; ++c)
                light.change[c] += carried.change[c] * light.at[c - way];
            carry_on(light.change, carried.at, way, width);
        }
        if constexpr (KEEPS) return;
        INDEPENDENT
        for (int c = 0; c < width; ++c) ways.own.put(c, ways.own[c] + within[c] * light[c - way]);
    }
    template <bool IS_ALONG, int POINTS> INLINE void follow_ways(
        const Here& here, const Ways<POINTS>& ways, const Line<N>& light) const {
        const bool is_thin = ways.step * here.deepest < F(0.5);
        in_stretches(here.from, here.to, of.width, is_thin, [&](auto of, int from, int to) HERE {
            follow_stretch<IS_ALONG, decltype(of)::matter>(ways, light, from, to);
        });
    }
    template <bool IS_ALONG, Matter MATTER, int POINTS>
    __attribute__((noinline)) void follow_stretch(
        const Ways<POINTS>& given, const Line<N>& light, int from, int to) const {
        const Ways<POINTS> ways = given;
        const N scale = this->scale * ways.step, inflow = this->inflow;
        const N strength = this->strength * ways.step;
        const Line<N> carried = line_at<N>(scratch_row(0), of.pitch);
        const Line<N> within = line_at<N>(scratch_row(2), of.pitch);
        INDEPENDENT
        for (int c = from; c < to; ++c) {
            const N arriving = gather<POINTS>(ways.from, ways.part, c);
            if constexpr (MATTER == EMPTY) {
                light.put(c, arriving);
                if constexpr (!KEEPS) ways.own.put(c, arriving);
                if constexpr (IS_ALONG) carried.put(c, N(ways.part[0]));
                if constexpr (IS_ALONG && !KEEPS) within.put(c, N(ways.part[0]));
            } else {
                const N depth = scale * ways.e[c], scatters = strength * ways.sc[c];
                const Emitted<N> emitted = {scatters * ways.own[c], scatters * ways.rise(c)};
                const Passage<N> by = pass_through<MATTER>(value_of(depth), depth);
                light.put(c, light_after(arriving, emitted, inflow, by));
                if constexpr (IS_ALONG) carried.put(c, ways.part[0] * by.passed);
                if constexpr (KEEPS) continue;
                ways.own.put(c, light_within(arriving, emitted, inflow, by));
                if constexpr (IS_ALONG) within.put(c, ways.part[0] * by.phi);
            }
        }
    }
    // What is found: moments of light, of which the known ones are taken away; or their changes.
    INLINE void add_moments(const Here& here) const {
        F* const begin = found_row(here);
        const F* taken[COUNT];
        F *found[COUNT], first = change_of(inflow);
        for (int i = 0; i < COUNT; ++i) {
            const int k = of.order[i];
            const bool is_known = k < 4 && !job.piece;
            const F* const* light = IS_CHANGED ? of.d_light : of.light;
            const F* known = is_known ? moment_of(light, of.light_low, k, all) : nullptr;
            taken[i] = row_of(known, job.color * cells + here.at);
            found[i] = begin + k * all;
        }
        to_moments<DEGREE>(
            matrix(1), found, taken, job.piece > 0 ? F(0) : first, of.adds,
            units_at(here, IS_CHANGED), -of.width, of.width);
    }
    INLINE F* found_row(const Here& here) const {
        return of.found + job.piece * COUNT * all + job.color * cells + here.at;
    }
};

template <class N, int DEGREE, bool SHARES_FIELD, class F>
INLINE void follow_rows(int lane, const Sweep<F>& of) {
    const Job job(lane, of);
    Rows<N, F, DEGREE, SHARES_FIELD, false>(of, job).follow(job.slice_from, job.slice_to);
}

} // namespace ddrecon
