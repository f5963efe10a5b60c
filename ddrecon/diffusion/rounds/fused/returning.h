#pragma once
#include "ddrecon/diffusion/rounds/fused/rows.h"
// Rows of cells along which radiance is followed backward: the adjoint of `Rows`.
//
// `Rows` kept what scatters and I of all slices of a slab. Of a row and a direction there are these
// lines of the last slice, which is the next one that light crosses:
//
//     RETURNING            exp(-depth) source_bar, which goes to the cells where the step began
//     FAR, MASS            cotangents of q and of extinction's field at these cells
//     SCATTERED            that of scattering's field, where it is another
//
// Where a step meets no medium, nothing returns to what scatters.

namespace ddrecon {

// With `VARIES_NUMBERS` derivatives by scales and inflow are asked for.
template <class F, int DEGREE, bool SHARES_FIELD, bool VARIES_NUMBERS> struct ReturningRows {
    typedef Rows<F, F, DEGREE, SHARES_FIELD, true> Light;
    typedef typename Light::Here Here;
    template <int POINTS> using Steps = typename Light::template Steps<POINTS>;
    static constexpr int COUNT = Light::COUNT, KINDS = SHARES_FIELD ? 3 : 4;
    enum { RETURNING, FAR, MASS, SCATTERED };

    // Cells whose steps begin at those of a row, by their lines. What begins beyond a face of the
    // box took q at the face: then there may be two for each slice, row and column.
    struct Target {
        const F* lines;
        int shift;
        F part;
        bool is_inside;
    };
    // Of a row and a direction: where light went on to, by slice and row; cotangents of I, which
    // become those of what scatters, and of all else.
    template <int POINTS> struct Back {
        Line<F> from[POINTS];
        F *bar, *returning, *far, *mass, *scattered;
    };

    const Light& light;
    const Sweep<F>& of;
    const Job& job;
    const int width;
    const long long pitch, stride;
    F *const lines, *const e_bars, *const sc_bars;
    F *const source_bars, *const passing, *const scale_bar, *const strength_bar, *const inflow_bar;

    INLINE ReturningRows(const Light& light)
        : light(light),
          of(light.of),
          job(light.job),
          width(of.width),
          pitch(of.pitch),
          stride(KINDS * of.most * pitch),
          lines(of.returning + job.lane * ((of.height + 2) * stride + of.margin) + of.margin),
          e_bars(field_bar(of.e_bar, of.extinction_channels)),
          sc_bars(field_bar(of.sc_bar, of.scattering_channels)),
          source_bars(light.scratch_row(0)),
          passing(light.scratch_row(1)),
          scale_bar(light.scratch_row(2)),
          strength_bar(light.scratch_row(3)),
          inflow_bar(light.scratch_row(4)) {}

    INLINE F* field_bar(F* bars, int channels) const {
        const int own = job.piece * of.colors + job.color;
        const int shared = job.piece * of.together + job.color - of.color_from;
        return bars + (channels > 1 ? own : shared) * light.cells;
    }
    INLINE F* bar_of(int j) const { return light.scratch_row(5 + j); }
    INLINE F* line(int s, int t, int j) const {
        const int place = (of.height - 1 - t + 2LL * s) % (of.height + 2);
        return lines + place * stride + KINDS * (light.group->before + j) * pitch;
    }
    INLINE void clear(F* row) const {
        for (int c = 0; c < width; ++c) row[c] = F(0);
    }

    INLINE void return_row(const Here& here, bool is_adding) const {
        const long long at = job.color * light.cells + here.at;
        const long long ahead = -light.group->y_way * width;
        const Pairs<F> pairs = light.pairs_at(bar_of(0), pitch);
        // E2.10 transposed: I_bar.
        Sums<F, COUNT, 1> sums;
        F* found[COUNT];
        const F* taken[COUNT];
        for (int i = 0; i < COUNT; ++i) {
            sums.rows[i][0] = light.row_of(part_of(of.bars, of.order[i], light.all), at);
            sums.by[i][0] = F(1);
            found[i] = light.found_row(here) + of.order[i] * light.all;
            taken[i] = light.empty;
        }
        to_directions<DEGREE>(light.matrices[2], sums, pairs, ahead, 0, width);
        if (VARIES_NUMBERS) clear(scale_bar), clear(strength_bar), clear(inflow_bar);
        const auto begin = light.find_beginnings(here);
        for (int j = 0; j < light.group->members; ++j)
            if (light.course(j).count == 1)
                return_direction<1>(here, begin, j);
            else
                return_direction<4>(here, begin, j);
        if (VARIES_NUMBERS) {
            double* own_sums = of.sums + 3 * (2 * of.color_from * of.pieces + job.lane);
            const F* const rows[3] = {scale_bar, strength_bar, inflow_bar};
            for (int i = 0; i < 3; ++i) own_sums[i] += total(rows[i], width);
        }
        to_moments<DEGREE>(light.matrices[1], found, taken, F(0), is_adding, pairs, ahead, width);
    }

    template <int POINTS> INLINE void return_direction(
        const Here& here, const typename Light::Beginnings& begin, int j) const {
        const Steps<POINTS> steps = light.template find_steps<POINTS>(here, begin, j);
        const Course& course = light.course(j);
        const int x_way = course.x_way;
        F* own = line(here.s, here.t, j);
        Back<POINTS> back = {
            {}, bar_of(j), own, own + FAR * pitch, own + MASS * pitch, own + (KINDS - 1) * pitch};
        for (int kind = 0; kind < KINDS; ++kind)
            own[kind * pitch - 1] = own[kind * pitch + width] = F(0);
        // What returns from the cells to which light went on, but for those of this row.
        F* next[4];
        for (int i = 0; i < 4; ++i) {
            const int s = here.s + i / 2, t = here.t + i % 2;
            next[i] = s < of.depth && t < of.height ? line(s, t, j) : nullptr;
        }
        UNROLLED
        for (int i = 0; i < POINTS; ++i) {
            const int *point = course.points[i], place = 2 * point[0] + point[1];
            back.from[i] = {place && next[place] ? next[place] : light.empty};
            back.from[i] = back.from[i] + point[2] * x_way;
        }
        if (course.is_along) {
            carry_back(steps, back, x_way);
            return_steps<true>(here, steps, back);
        } else {
            return_steps<false>(here, steps, back);
        }
        // By q and by the fields where steps begin.
        F *e_bar = e_bars + here.at, *sc_bar = sc_bars + here.at;
        INDEPENDENT
        for (int c = 0; c < width; ++c) {
            e_bar[c] += back.mass[c];
            if constexpr (!SHARES_FIELD) sc_bar[c] += back.scattered[c];
        }
        Target targets[16];
        const int count = find_targets(here, course, steps.part, next, targets);
        for (int i = 0; i < count; ++i) {
            const Target target = targets[i];
            const F* far = target.lines + FAR * pitch + target.shift;
            const F* mass = target.lines + MASS * pitch + target.shift;
            const F* scattered = target.lines + (KINDS - 1) * pitch + target.shift;
            INDEPENDENT
            for (int c = 0; c < width; ++c) back.bar[c] += target.part * far[c];
            const int edge = target.shift > 0 ? 0 : width - 1;
            if (target.shift) back.bar[edge] += target.part * far[edge - target.shift];
            if (!target.is_inside) continue;
            INDEPENDENT
            for (int c = 0; c < width; ++c) {
                e_bar[c] += target.part * mass[c];
                if constexpr (!SHARES_FIELD) sc_bar[c] += target.part * scattered[c];
            }
        }
    }
    INLINE int find_targets(
        const Here& here, const Course& course, const F* part, const F* const* next,
        Target* found) const {
        int count = 0;
        for (int i = 0; i < course.count; ++i) {
            const int* point = course.points[i];
            for (int a = 0; a <= (point[0] && here.s == 0); ++a)
                for (int b = 0; b <= (point[1] && here.t == 0); ++b)
                    if (const F* to = next[2 * (a ? 0 : point[0]) + (b ? 0 : point[1])])
                        found[count++] = {to, point[2] * course.x_way, part[i], !a && !b};
        }
        return count;
    }
    // That of the source along the row itself.
    template <int POINTS>
    INLINE void carry_back(const Steps<POINTS>& given, const Back<POINTS>& back, int x_way) const {
        const Steps<POINTS> steps = given;
        const F scale = light.scale;
        F *const bars = source_bars, *const passing = this->passing;
        INDEPENDENT
        for (int c = 0; c < width; ++c) {
            passing[c] = steps.part[0] * decay(scale * steps.mass(c));
            bars[c] = back.bar[c] + gather<POINTS>(back.from, steps.part, c);
        }
        passing[-1] = passing[width] = F(0);
        carry_on(bars, passing + x_way, -x_way, width);
    }
    template <bool IS_ALONG, int POINTS> INLINE void return_steps(
        const Here& here, const Steps<POINTS>& steps, const Back<POINTS>& back) const {
        const bool is_thin = steps.half * here.deepest < F(0.25);
        in_stretches(here.from, here.to, width, is_thin, [&](auto of, int from, int to) HERE {
            return_stretch<IS_ALONG, decltype(of)::matter>(steps, back, from, to);
        });
    }
    template <bool IS_ALONG, Matter MATTER, int POINTS>
    __attribute__((noinline)) void return_stretch(
        const Steps<POINTS>& given, const Back<POINTS>& given_back, int from, int to) const {
        const Steps<POINTS> steps = given;
        const Back<POINTS> back = given_back;
        const F scale = light.scale, strength = light.strength, inflow = light.inflow;
        F *const source_bars = this->source_bars, *const scale_bar = this->scale_bar;
        F *const strength_bar = this->strength_bar, *const inflow_bar = this->inflow_bar;
        constexpr bool IS_EMPTY = MATTER == EMPTY;
        INDEPENDENT
        for (int c = from; c < to; ++c) {
            const F arriving = gather<POINTS>(steps.light_from, steps.part, c);
            const F far = gather<POINTS>(steps.near_from, steps.part, c), near = steps.near[c];
            const F mass = IS_EMPTY ? F(0) : steps.mass(c);
            const F scattering_mass = IS_EMPTY ? F(0) : steps.scattering_mass(c);
            const F radiance_bar = back.bar[c];
            // That of the source: what goes on, returns.
            const F source_bar =
                IS_ALONG ? source_bars[c] : radiance_bar + gather<POINTS>(back.from, steps.part, c);
            const StepBars<F> bars = return_step<MATTER>(
                source_bar, arriving, far, near, mass, scattering_mass, scale, strength, inflow);
            const F scattered = steps.half * bars.scattering_mass;
            back.mass[c] = steps.half * bars.mass + (SHARES_FIELD ? scattered : F(0));
            if constexpr (!SHARES_FIELD) back.scattered[c] = scattered;
            back.returning[c] = bars.arriving;
            back.far[c] = bars.far;
            back.bar[c] = bars.near;
            if constexpr (VARIES_NUMBERS) {
                scale_bar[c] += bars.scale;
                strength_bar[c] += bars.strength;
                inflow_bar[c] += radiance_bar + bars.inflow;
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
        for (int s = to - 1; s >= from; --s)
            for (int g = job.group_to - 1; g >= job.group_from; --g) {
                light.enter_group(g);
                for (int t = of.height - 1; t >= 0; --t)
                    back.return_row(light.place(s, t), of.adds || g < job.group_to - 1);
            }
    }
}

} // namespace ddrecon
