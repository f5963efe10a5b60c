#pragma once
#include "ddrecon/diffusion/rounds/fused/moments.h"
// Rows of cells along which radiance is followed (E2.9, E2.10).
//
// A lane goes through the slices across z in the way that its light takes, s counting them, and in
// each through the rows, t counting them in the way of a group of directions. A step begins at a
// mean of up to four cells, which lie in this slice or the one before, in this row or the one
// before: wherever a direction goes, they were done already. Of a row and a direction there are two
// lines of numbers: NEAR, what scatters along it, and LIGHT, I less the light from outside; of
// tangents their changes as well. Lines of the last slice are kept, each in the place of one that
// no step needs any more. I before each slab of slices is saved: for the adjoint, light goes
// through a slab once more, and lines of all its slices are kept.
//
// Behind each row there are at least two cells that hold what is beyond its ends. Where a step
// meets no medium, light is only moved: that is decided for stretches of a row.

namespace ddrecon {

// Numbers N; moments to DEGREE; whether extinction and scattering have the same field, and whether
// lines of all slices are kept.
template <class N, class F, int DEGREE, bool SHARES_FIELD, bool KEEPS> struct Rows {
    static constexpr bool IS_CHANGED = sizeof(N) > sizeof(F);
    static constexpr int COUNT = Order<DEGREE>::COUNT, LINES = IS_CHANGED ? 4 : 2;
    enum { NEAR, LIGHT };

    // A row of cells where a step's end lies: its slice and its turn, where it is among cells and
    // in fields that have a layer around them, and where steps to it meet a medium.
    struct Here {
        int s, t, from, to;
        long long at, row;
        F deepest;
        const int* range;
    };
    // Lines where steps to a row may begin, of the group's first direction: in this slice or the
    // one before, in this row or the one before. Beyond the faces of the box are neither medium nor
    // I; q is repeated there.
    struct Beginnings {
        Line<N> near[4], light[4];
        bool is_inside[4];
        long long back[4];
    };
    // What steps to a row along a direction begin with, and what they meet at their ends.
    template <int POINTS> struct Steps {
        Line<N> near, e, sc, near_from[POINTS], light_from[POINTS], e_from[POINTS], sc_from[POINTS];
        F half, part[POINTS];
        INLINE N mass(int c) const { return half * (e[c] + gather<POINTS>(e_from, part, c)); }
        INLINE N scattering_mass(int c) const {
            if constexpr (SHARES_FIELD)
                return mass(c);
            else
                return half * (sc[c] + gather<POINTS>(sc_from, part, c));
        }
    };

    const Sweep<F>& of;
    const Job& job;
    const long long plane, cells, all, sheet, padded, stride;
    F *const scratch, *const empty, *const lines;
    const Line<N> e_cells, sc_cells;
    N scale, strength, inflow;
    int slice_from = 0;
    const Group* group = nullptr;
    const F* matrices[4] = {};

    INLINE Rows(const Sweep<F>& of, const Job& job)
        : of(of),
          job(job),
          plane((long long)of.height * of.width),
          cells(of.depth * plane),
          all(of.colors * cells),
          sheet((of.height + 2LL) * of.pitch),
          padded((of.depth + 2) * sheet),
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
          scale(number(0)),
          strength(number(1)),
          inflow(number(2)) {}

    INLINE Line<N> field(const F* of_all, int channels) const {
        const long long own = channels > 1 ? job.color * padded : 0;
        return line_at<N>(of_all + of.margin + sheet + of.pitch + own, channels * padded);
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

    INLINE void enter_group(int g) {
        group = (const Group*)of.groups + g;
        for (int i = 0; i < 4; ++i)
            matrices[i] = of.matrices + group->matrices + i * group->pairs * COUNT;
    }
    INLINE Pairs<F> pairs_at(F* first, long long apart) const {
        return {of.pairs + 2 * group->first_pair, group->pairs, first,
                scratch_row(5 + of.most),         apart,        of.pitch};
    }
    INLINE Here place(int s, int t) const {
        const int k = job.way > 0 ? s : of.depth - 1 - s;
        const int r = group->y_way > 0 ? t : of.height - 1 - t;
        const int* range = of.ranges + 4 * (k * of.height + r);
        return {
            s,
            t,
            range[0],
            range[1],
            k * plane + (long long)r * of.width,
            k * sheet + (long long)r * of.pitch,
            value_of(scale) * of.densest[k * of.height + r],
            range};
    }
    INLINE Beginnings find_beginnings(const Here& here) const {
        Beginnings found;
        for (int i = 0; i < 4; ++i) {
            const int s = here.s - i / 2, t = here.t - i % 2;
            found.is_inside[i] = s >= 0 && t >= 0;
            found.near[i] = line(s < 0 ? 0 : s, t < 0 ? 0 : t, NEAR, group->before);
            if (found.is_inside[i]) found.light[i] = line(s, t, LIGHT, group->before);
            found.back[i] = i / 2 * job.way * sheet + i % 2 * group->y_way * of.pitch;
        }
        return found;
    }
    INLINE const Course& course(int j) const {
        return ((const Course*)of.courses)[group->begin + j];
    }
    template <int POINTS>
    INLINE Steps<POINTS> find_steps(const Here& here, const Beginnings& begin, int j) const {
        Steps<POINTS> found;
        const Course& own = course(j);
        const Parts<F>& parts = ((const Parts<F>*)of.parts)[group->begin + j];
        const long long own_line = (long long)LINES * j * of.pitch;
        found.half = parts.half;
        found.near = line(here.s, here.t, NEAR, group->before + j);
        found.e = e_cells + here.row;
        found.sc = sc_cells + here.row;
        UNROLLED
        for (int i = 0; i < POINTS; ++i) {
            const int *point = own.points[i], place = 2 * point[0] + point[1];
            const int shift = point[2] * own.x_way;
            found.part[i] = parts.part[i];
            found.near_from[i] = begin.near[place] + (own_line - shift);
            found.light_from[i] = begin.is_inside[place] ? begin.light[place] + (own_line - shift)
                                                         : nothing() + -shift;
            found.e_from[i] = found.e + (-begin.back[place] - shift);
            found.sc_from[i] = found.sc + (-begin.back[place] - shift);
        }
        return found;
    }
    INLINE Line<N> nothing() const { return line_at<N>(empty, 0); }

    // What scatters along each direction of a row, from sums of the moments of what was found, is
    // known and is given (E2.10).
    INLINE const F* row_of(const F* part, long long at) const { return part ? part + at : empty; }
    INLINE void find_scattering(const Here& here, int from, int to) const {
        const long long at = job.color * cells + here.at, ahead = group->y_way * of.width;
        Sums<F, COUNT, 2> sums;
        for (int i = 0; i < COUNT; ++i) {
            const int k = of.order[i], own = k * of.colors + job.color;
            const F* light = part_of(of.light_parts, k, all);
            const F* source =
                of.beam_factors ? of.source_parts[0] : part_of(of.source_parts, k, all);
            sums.rows[i][0] = row_of(light, at), sums.rows[i][1] = row_of(source, at);
            sums.by[i][0] = of.factors[own];
            sums.by[i][1] = of.beam_factors ? of.beam_factors[own] : F(1);
        }
        const Line<N> near = line(here.s, here.t, NEAR, group->before);
        const long long apart = (long long)LINES * of.pitch;
        to_directions<DEGREE>(matrices[0], sums, pairs_at(near.at, apart), ahead, from, to);
        if constexpr (IS_CHANGED) {
            Sums<F, COUNT, 3> changes;
            for (int i = 0; i < COUNT; ++i) {
                const int k = of.order[i], own = k * of.colors + job.color;
                const F* const* parts[3] = {of.d_source_parts, of.d_light_parts, of.light_parts};
                const F by[3] = {F(1), of.factors[own], of.d_factors[own]};
                for (int n = 0; n < 3; ++n) {
                    changes.rows[i][n] = row_of(part_of(parts[n], k, all), at);
                    changes.by[i][n] = by[n];
                }
            }
            const Pairs<F> pairs = pairs_at(near.change, apart);
            to_directions<DEGREE>(matrices[0], changes, pairs, ahead, from, to);
        }
    }

    // Light through the slices from `slice_from` on.
    INLINE void follow(int slice_from, int slice_to) {
        this->slice_from = slice_from;
        for (int s = slice_from - (KEEPS && slice_from > 0); s < slice_to; ++s)
            for (int g = job.group_from; g < job.group_to; ++g) {
                enter_group(g);
                for (int t = 0; t < of.height; ++t) {
                    const Here here = place(s, t);
                    find_scattering(
                        here, KEEPS ? 0 : here.range[2], KEEPS ? of.width : here.range[3]);
                    follow_row(here);
                    if constexpr (!KEEPS) add_moments(here, of.adds || g > job.group_from);
                }
            }
    }
    INLINE void follow_row(const Here& here) const {
        const int width = of.width;
        const Beginnings begin = find_beginnings(here);
        for (int j = 0; j < group->members; ++j) {
            const Course& own = course(j);
            const Line<N> near = line(here.s, here.t, NEAR, group->before + j);
            const Line<N> light = line(here.s, here.t, LIGHT, group->before + j);
            light.put(-1, N(F(0)));
            light.put(width, N(F(0)));
            if (own.x_way > 0)
                near.put(-1, near[0]);
            else
                near.put(width, near[width - 1]);
            if (KEEPS && here.s < slice_from) {
                const F* row = saved_row(here.s + 1, here.t, group->begin + j);
                for (int c = 0; c < width; ++c) light.at[c] = row[c];
                continue;
            }
            if (own.count == 1)
                follow_direction<1>(here, begin, light, j);
            else
                follow_direction<4>(here, begin, light, j);
            if (!KEEPS && of.saved && here.s + 1 < of.depth && slab_of(here.s + 1) == here.s + 1) {
                F* row = saved_row(here.s + 1, here.t, group->begin + j);
                for (int c = 0; c < width; ++c) row[c] = light.at[c];
            }
        }
    }
    template <int POINTS> INLINE void follow_direction(
        const Here& here, const Beginnings& begin, const Line<N>& light, int j) const {
        Steps<POINTS> steps = find_steps<POINTS>(here, begin, j);
        const Course& own = course(j);
        if (!own.is_along) {
            follow_steps<false>(here, steps, light);
            return;
        }
        // What comes along the row itself is carried on cell by cell.
        UNROLLED
        for (int i = 0; i < POINTS; ++i)
            if (!own.points[i][0] && !own.points[i][1]) steps.light_from[i] = nothing();
        follow_steps<true>(here, steps, light);
        const Line<N> carried = line_at<N>(scratch_row(0), of.pitch);
        const int way = own.x_way, width = of.width;
        carry_on(light.at, carried.at, way, width);
        if constexpr (IS_CHANGED) {
            INDEPENDENT
            for (int c = 0; c < width; ++c)
                light.change[c] += carried.change[c] * light.at[c - way];
            carry_on(light.change, carried.at, way, width);
        }
    }
    template <bool IS_ALONG, int POINTS> INLINE void follow_steps(
        const Here& here, const Steps<POINTS>& steps, const Line<N>& light) const {
        const bool is_thin = steps.half * here.deepest < F(0.25);
        in_stretches(here.from, here.to, of.width, is_thin, [&](auto of, int from, int to) HERE {
            follow_stretch<IS_ALONG, decltype(of)::matter>(steps, light, from, to);
        });
    }
    template <bool IS_ALONG, Matter MATTER, int POINTS>
    __attribute__((noinline)) void follow_stretch(
        const Steps<POINTS>& given, const Line<N>& light, int from, int to) const {
        const Steps<POINTS> steps = given;
        const N scale = this->scale, strength = this->strength, inflow = this->inflow;
        const Line<N> carried = line_at<N>(scratch_row(0), of.pitch);
        INDEPENDENT
        for (int c = from; c < to; ++c) {
            const N arriving = gather<POINTS>(steps.light_from, steps.part, c);
            if constexpr (MATTER == EMPTY) {
                light.put(c, arriving);
                if constexpr (IS_ALONG) carried.put(c, N(steps.part[0]));
            } else {
                const N far = gather<POINTS>(steps.near_from, steps.part, c), near = steps.near[c];
                const N mass = steps.mass(c), depth = scale * mass;
                const N scattering_depth = steps.scattering_mass(c) * strength;
                const Passage<N> by = pass_through<MATTER>(value_of(depth), depth);
                light.put(c, light_after(arriving, far, near, scattering_depth, inflow, by));
                if constexpr (IS_ALONG) carried.put(c, steps.part[0] * by.passed);
            }
        }
    }
    // What is found: moments of light, of which the known ones are taken away; or their changes.
    INLINE void add_moments(const Here& here, bool is_adding) const {
        const Line<N> light = line(here.s, here.t, LIGHT, group->before);
        F* const begin = found_row(here);
        const F* taken[COUNT];
        F *found[COUNT], first = change_of(inflow), *lines = light.at;
        if constexpr (IS_CHANGED) lines = light.change;
        for (int i = 0; i < COUNT; ++i) {
            const int k = of.order[i];
            const bool is_known = k < 4 && !job.piece;
            const F* const* light_parts = IS_CHANGED ? of.d_light_parts : of.light_parts;
            const F* part = is_known ? part_of(light_parts, k, all) : nullptr;
            taken[i] = row_of(part, job.color * cells + here.at);
            found[i] = begin + k * all;
        }
        to_moments<DEGREE>(
            matrices[3], found, taken, job.piece > 0 ? F(0) : first, is_adding,
            pairs_at(lines, (long long)LINES * of.pitch), group->y_way * of.width, of.width);
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
