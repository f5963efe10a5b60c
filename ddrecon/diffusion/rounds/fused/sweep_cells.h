#pragma once
#include "ddrecon/diffusion/rounds/fused/lines.h"
// Cells that radiance reaches, one a thread: sweeps on a GPU (E11, E12).
//
// All directions go on by a slice at a time, each across the axis along which it crosses most
// cells. What scatters and I are arrays of all directions, [D, C, z, y, x].

namespace ddrecon {

struct Place {
    int at[3];
};

// A cell that light along a direction reaches, of a color, in numbers N.
template <class N, bool SHARES_FIELD, class F> struct CellStep {
    const CellSweep<F>& of;
    const Course& course;
    const Parts<F>& parts;
    const int color;
    const long long cells, all, own_e, own_sc;
    Place own;

    INLINE CellStep(const CellSweep<F>& of, int j, int color)
        : of(of),
          course(((const Course*)of.courses)[j]),
          parts(((const Parts<F>*)of.parts)[j]),
          color(color),
          cells((long long)of.shape[0] * of.shape[1] * of.shape[2]),
          all(((long long)j * of.colors + color) * cells),
          own_e(of.extinction_channels > 1 ? color * cells : 0),
          own_sc(of.scattering_channels > 1 ? color * cells : 0) {}
    INLINE N pair(const F* values, const F* changes, long long at) const {
        if constexpr (sizeof(N) == sizeof(F))
            return values[at];
        else
            return N(values[at], changes[at]);
    }
    INLINE N number(int which) const {
        return pair(of.scales, of.d_scales, which * of.colors + color);
    }
    INLINE long long index(const Place& p) const {
        return ((long long)p.at[0] * of.shape[1] + p.at[1]) * of.shape[2] + p.at[2];
    }
    // To the place of a point of the step, against the way of light or with it; within the box?
    INLINE bool move(int point, int forward, Place& found) const {
        bool is_inside = true;
        for (int a = 0; a < 3; ++a) {
            found.at[a] = own.at[a] + forward * course.signs[a] * course.points[point][a];
            is_inside = is_inside && found.at[a] >= 0 && found.at[a] < of.shape[a];
        }
        return is_inside;
    }
    // The cell of an item in the slice that its direction has reached; is there one?
    INLINE bool enter_slice(int i) {
        const int axis = course.axis, n = of.shape[axis];
        if (i >= cells / n || of.slice >= n) return false;
        const int columns = axis == 2 ? of.shape[1] : of.shape[2];
        own.at[axis] = course.signs[axis] > 0 ? of.slice : n - 1 - of.slice;
        own.at[axis == 0 ? 1 : 0] = i / columns;
        own.at[axis == 2 ? 1 : 2] = i % columns;
        return true;
    }

    // Both ends of the step. Beyond the box are neither medium nor I, and q is that at its face.
    struct Ends {
        N arriving, far, near, mass, scattering_mass;
    };
    INLINE Ends find_ends() const {
        Ends found = {N(F(0)), N(F(0)), N(F(0)), N(F(0)), N(F(0))};
        for (int point = 0; point < course.count; ++point) {
            const F part = parts.part[point];
            Place from;
            if (move(point, -1, from)) {
                found.arriving += part * pair(of.light, of.d_light, all + index(from));
                add_masses(found, part, index(from));
            }
            for (int a = 0; a < 3; ++a)
                from.at[a] = from.at[a] < 0             ? 0
                             : from.at[a] < of.shape[a] ? from.at[a]
                                                        : of.shape[a] - 1;
            found.far += part * pair(of.near, of.d_near, all + index(from));
        }
        add_masses(found, F(1), index(own));
        found.near = pair(of.near, of.d_near, all + index(own));
        found.mass = parts.half * found.mass;
        found.scattering_mass = SHARES_FIELD ? found.mass : parts.half * found.scattering_mass;
        return found;
    }
    INLINE void add_masses(Ends& found, F part, long long at) const {
        found.mass += part * pair(of.extinction, of.d_extinction, own_e + at);
        if constexpr (!SHARES_FIELD)
            found.scattering_mass += part * pair(of.scattering, of.d_scattering, own_sc + at);
    }
};

template <class N, bool SHARES_FIELD, class F>
INLINE void follow_cells(int item, const CellSweep<F>& of) {
    CellStep<N, SHARES_FIELD, F> step(of, item / of.most / of.colors, item / of.most % of.colors);
    if (!step.enter_slice(item % of.most)) return;
    const auto ends = step.find_ends();
    const N depth = step.number(0) * ends.mass;
    const N after = light_after(
        ends.arriving, ends.far, ends.near, ends.scattering_mass * step.number(1), step.number(2),
        pass_through<ANY>(value_of(depth), depth));
    const long long at = step.all + step.index(step.own);
    of.light[at] = value_of(after);
    if constexpr (sizeof(N) > sizeof(F)) of.d_light[at] = after.by[0];
}

// Cotangents by q and by the fields at both ends of the step, in `bar`, `far_bar` and `mass_bar`.
template <bool SHARES_FIELD, bool VARIES_NUMBERS, class F>
INLINE void return_cells(int item, const CellSweep<F>& of) {
    CellStep<F, SHARES_FIELD, F> step(of, item / of.most / of.colors, item / of.most % of.colors);
    if (!step.enter_slice(item % of.most)) return;
    const auto ends = step.find_ends();
    const long long at = step.all + step.index(step.own);
    F source_bar = of.bar[at];
    for (int point = 0; point < step.course.count; ++point) {
        Place to;
        if (step.move(point, 1, to))
            source_bar += step.parts.part[point] * of.returning[step.all + step.index(to)];
    }
    const StepBars<F> bars = return_step<ANY>(
        source_bar, ends.arriving, ends.far, ends.near, ends.mass, ends.scattering_mass,
        step.number(0), step.number(1), step.number(2));
    const F mass_bar = step.parts.half * bars.mass;
    const F scattering_bar = step.parts.half * bars.scattering_mass;
    of.returning[at] = bars.arriving;
    of.far_bar[at] = bars.far;
    of.mass_bar[at] = mass_bar + (SHARES_FIELD ? scattering_bar : F(0));
    if constexpr (!SHARES_FIELD) of.scattered_bar[at] = scattering_bar;
    if constexpr (VARIES_NUMBERS) {
        of.scale_bars[at] = bars.scale;
        of.strength_bars[at] = bars.strength;
        of.inflow_bars[at] = of.bar[at] + bars.inflow;
    }
    of.bar[at] = bars.near;
}

// To each cell what steps from it have, which began there; an item is a cell of a direction.
template <bool SHARES_FIELD, class F> INLINE void collect_cells(int item, const CellSweep<F>& of) {
    const long long size = (long long)of.shape[0] * of.shape[1] * of.shape[2], cell = item % size;
    CellStep<F, SHARES_FIELD, F> step(of, (int)(item / size / of.colors), item / size % of.colors);
    const int width = of.shape[2], height = of.shape[1];
    step.own = {{(int)(cell / width / height), (int)(cell / width % height), (int)(cell % width)}};
    const long long all = step.all, at = all + cell;
    F q_bar = of.bar[at], e_bar = of.mass_bar[at];
    F sc_bar = SHARES_FIELD ? F(0) : of.scattered_bar[at];
    for (int point = 0; point < step.course.count; ++point) {
        const F part = step.parts.part[point];
        Place to;
        if (step.move(point, 1, to)) {
            e_bar += part * of.mass_bar[all + step.index(to)];
            if constexpr (!SHARES_FIELD) sc_bar += part * of.scattered_bar[all + step.index(to)];
        }
        // At a face q stands for what is beyond it as well.
        Place before;
        step.move(point, -1, before);
        for (int choice = 0; choice < 8; ++choice) {
            Place met = to;
            bool is_met = true;
            for (int a = 0; a < 3; ++a) {
                const bool stays = choice >> a & 1;
                const bool is_end = before.at[a] < 0 || before.at[a] >= of.shape[a];
                if (stays) met.at[a] = step.own.at[a];
                is_met = is_met && stays <= is_end && met.at[a] >= 0 && met.at[a] < of.shape[a];
            }
            if (is_met) q_bar += part * of.far_bar[all + step.index(met)];
        }
    }
    of.q_bars[at] = q_bar;
    of.returning[at] = e_bar;
    if constexpr (!SHARES_FIELD) of.light[at] = sc_bar;
}

} // namespace ddrecon
