#pragma once
#include "ddrecon/transport/fused/rows.h"
// Rows of cells along which radiance is followed backward: the adjoint of `Rows`.
//
// `Rows` kept what scatters and I of all slices of a slab. Of a row and a direction there are two
// lines of cotangents: BAR, of means of I, which become those of what scatters, and RETURNING, of
// what comes to cells, which go to those it comes from; those of the last slice are kept, which is
// the next one that light crosses.

namespace ddrecon {

// With `VARIES_NUMBERS` derivatives by scales and inflow are asked for.
template <class F, int DEGREE, bool SHARES_FIELD, bool VARIES_NUMBERS> struct ReturningRows {
    typedef Rows<F, F, DEGREE, SHARES_FIELD, true> Light;
    typedef typename Light::Here Here;
    template <int POINTS> using Ways = typename Light::template Ways<POINTS>;
    static constexpr int COUNT = Light::COUNT;
    enum { BAR, RETURNING };

    // Of a row and a direction: where light went on to, by slice and row; both lines.
    template <int POINTS> struct Back {
        Line<F> from[POINTS];
        F *bar, *returning;
    };

    const Light& light;
    const Sweep<F>& of;
    const Job& job;
    const int width;
    const long long pitch, stride;
    F *const lines, *const e_bars, *const sc_bars, *const gradient_bars;
    F *const passing, *const scale_bar, *const strength_bar, *const inflow_bar;

    INLINE ReturningRows(const Light& light)
        : light(light),
          of(light.of),
          job(light.job),
          width(of.width),
          pitch(of.pitch),
          stride(2LL * of.most * pitch),
          lines(of.returning + job.lane * ((of.height + 2) * stride + of.margin) + of.margin),
          e_bars(field_bar(of.e_bar, of.extinction_channels)),
          sc_bars(field_bar(of.sc_bar, of.scattering_channels)),
          gradient_bars(of.gradient_bar + job.piece * 3 * light.all + job.color * light.cells),
          passing(light.scratch_row(1)),
          scale_bar(light.scratch_row(2)),
          strength_bar(light.scratch_row(3)),
          inflow_bar(light.scratch_row(4)) {}

    INLINE F* field_bar(F* bars, int channels) const {
        const int own = job.piece * of.colors + job.color;
        const int shared = job.piece * of.together + job.color - of.color_from;
        return bars + (channels > 1 ? own : shared) * light.cells;
    }
    INLINE F* line(int s, int t, int which, int j) const {
        const int place = (of.height - 1 - t + 2LL * s) % (of.height + 2);
        return lines + place * stride + (2 * j + which) * pitch;
    }
    INLINE Units<F> units_at(const Here& here) const {
        F* const downs = line(here.s, of.height - 1 - here.t, BAR, 0);
        return light.units_of(line(here.s, here.t, BAR, 0), downs, 2 * pitch);
    }
    INLINE void clear(F* row) const {
        for (int c = 0; c < width; ++c) row[c] = F(0);
    }

    // E2.10 transposed: cotangents of means of I, and moments of what has become of them.
    INLINE void find_bars(const Here& here) const {
        Sums<F, COUNT, 1> sums;
        const long long at = job.color * light.cells + here.at;
        for (int i = 0; i < COUNT; ++i) {
            sums.rows[i][0] = light.row_of(moment_of(of.bars, 4, of.order[i], light.all), at);
            sums.by[i][0] = F(1);
        }
        to_directions<DEGREE>(light.matrix(1), sums, units_at(here), -width, 0, width);
    }
    INLINE void add_moments(const Here& here) const {
        F* found[COUNT];
        const F* taken[COUNT];
        for (int i = 0; i < COUNT; ++i) {
            found[i] = light.found_row(here) + of.order[i] * light.all;
            taken[i] = light.empty;
        }
        to_moments<DEGREE>(
            light.matrix(0), found, taken, F(0), of.adds, units_at(here), width, width);
    }
    INLINE void return_row(const Here& here) const {
        if (VARIES_NUMBERS) clear(scale_bar), clear(strength_bar), clear(inflow_bar);
        const auto before = light.find_before(here);
        for (int j = light.first(here); j < light.last(here); ++j)
            if (light.course(j).count == 1)
                return_direction<1>(here, before, j);
            else
                return_direction<4>(here, before, j);
        if (VARIES_NUMBERS) {
            double* own_sums = of.sums + 3 * (2 * of.color_from * of.pieces + job.lane);
            const F* const rows[3] = {scale_bar, strength_bar, inflow_bar};
            for (int i = 0; i < 3; ++i) own_sums[i] += total(rows[i], width);
        }
    }

    template <int POINTS> INLINE void return_direction(
        const Here& here, const typename Light::Before& before, int j) const {
        const Ways<POINTS> ways = light.template find_ways<POINTS>(here, before, j);
        const Course& course = light.course(j);
        F* own = line(here.s, here.t, RETURNING, j);
        Back<POINTS> back = {{}, line(here.s, here.t, BAR, j), own};
        own[-1] = own[width] = F(0);
        // What returns from the cells to which light went on, but for those of this row.
        UNROLLED
        for (int i = 0; i < POINTS; ++i) {
            const int *point = course.points[i], s = here.s + point[0], t = here.t + point[1];
            const bool is_there = (point[0] || point[1]) && s < of.depth && t < of.height;
            back.from[i] = {is_there ? line(s, t, RETURNING, j) : light.empty};
            back.from[i] = back.from[i] + point[2] * course.x_way;
        }
        if (course.is_along) {
            carry_back(ways, back, course.x_way);
            // The first point lies along the row.
            back.from[0] = Line<F>{own} + course.x_way;
            return_ways<true>(here, ways, back);
        } else {
            return_ways<false>(here, ways, back);
        }
    }
    // What returns along the row itself is carried on cell by cell.
    template <int POINTS>
    INLINE void carry_back(const Ways<POINTS>& given, const Back<POINTS>& back, int x_way) const {
        const Ways<POINTS> ways = given;
        const F scale = light.scale * ways.step;
        F* const passing = this->passing;
        INDEPENDENT
        for (int c = 0; c < width; ++c) {
            const F depth = scale * ways.e[c];
            const Passage<F> by = pass_through<ANY>(depth, depth);
            passing[c] = ways.part[0] * by.passed;
            back.returning[c] =
                gather<POINTS>(back.from, ways.part, c) * by.passed + back.bar[c] * by.phi;
        }
        carry_on(back.returning, passing, -x_way, width);
    }
    template <bool IS_ALONG, int POINTS> INLINE void return_ways(
        const Here& here, const Ways<POINTS>& ways, const Back<POINTS>& back) const {
        const bool is_thin = ways.step * here.deepest < F(0.5);
        in_stretches(here.from, here.to, width, is_thin, [&](auto of, int from, int to) HERE {
            return_stretch<IS_ALONG, decltype(of)::matter>(here, ways, back, from, to);
        });
    }
    // E2.9 transposed.
    template <bool IS_ALONG, Matter MATTER, int POINTS>
    __attribute__((noinline)) void return_stretch(
        const Here& here, const Ways<POINTS>& given, const Back<POINTS>& given_back, int from,
        int to) const {
        const Ways<POINTS> ways = given;
        const Back<POINTS> back = given_back;
        const F step = ways.step, scale = light.scale * step, strength = light.strength * step;
        const F inflow = light.inflow;
        F *const scale_bar = this->scale_bar, *const strength_bar = this->strength_bar;
        F *const inflow_bar = this->inflow_bar, *const e_bar = e_bars + here.at;
        F *const sc_bar = sc_bars + here.at, *const gradient_bar = gradient_bars + here.at;
        const long long all = light.all;
        INDEPENDENT
        for (int c = from; c < to; ++c) {
            const F arriving = gather<POINTS>(ways.from, ways.part, c);
            const F e = MATTER == EMPTY ? F(0) : ways.e[c],
                    sc = MATTER == EMPTY ? F(0) : ways.sc[c];
            const F own = ways.own[c], rise = ways.rise(c), scatters = strength * sc;
            const F within_bar = back.bar[c], after_bar = gather<POINTS>(back.from, ways.part, c);
            const Passage<Dual<F>> by = pass_through<MATTER>(scale * e, Dual<F>(scale * e, F(1)));
            const Emitted<F> emitted = {scatters * own, scatters * rise};
            const F depth_bar = after_bar * light_after(arriving, emitted, inflow, by).by[0] +
                                within_bar * light_within(arriving, emitted, inflow, by).by[0];
            const F whole_bar = after_bar * by.phi.value + within_bar * by.psi.value;
            const F rise_bar = after_bar * by.rising.value - within_bar * by.eta.value;
            const F scatters_bar = whole_bar * own + rise_bar * rise;
            if constexpr (!IS_ALONG)
                back.returning[c] = after_bar * by.passed.value + within_bar * by.phi.value;
            back.bar[c] = whole_bar * scatters;
            UNROLLED
            for (int a = 0; a < 3; ++a)
                gradient_bar[a * all + c] += rise_bar * scatters * ways.moved[a];
            const F mass_bar = depth_bar * scale, scattered = scatters_bar * strength;
            e_bar[c] += mass_bar + (SHARES_FIELD ? scattered : F(0));
            if constexpr (!SHARES_FIELD) sc_bar[c] += scattered;
            if constexpr (VARIES_NUMBERS) {
                scale_bar[c] += depth_bar * step * e;
                strength_bar[c] += scatters_bar * step * sc;
                inflow_bar[c] += within_bar * by.phi.value - after_bar * by.lost.value;
            }
        }
    }
};

// Slabs are gone through from the last one on: forward, and then back.
template <int DEGREE, bool SHARES_FIELD, bool VARIES_NUMBERS, class F>
INLINE void return_rows(int lane, const Sweep<F>& of) {
    const Job job(lane, of);
    Rows<F, F, DEGREE, SHARES_FIELD, true> light(of, job);
    const ReturningRows<F, DEGREE, SHARES_FIELD, VARIES_NUMBERS> back(light);
    for (int from, to = job.slice_to; to > job.slice_from; to = from) {
        from = light.slab_of(to - 1);
        light.follow(from, to);
        for (int s = to - 1; s >= from; --s) {
            for (int t = of.height - 1; t >= 0; --t) {
                back.find_bars(light.place(s, t));
                back.return_row(light.place(s, t));
            }
            for (int t = of.height - 1; t >= 0; --t) {
                back.return_row(light.place(s, t, -1));
                back.add_moments(light.place(s, of.height - 1 - t));
            }
        }
    }
}

} // namespace ddrecon
