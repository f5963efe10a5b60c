#pragma once
#include "ddrecon/kernels/numbers.h"
// What Python gives to kernels of a sweep, by the names of fields (`records.py`).

namespace ddrecon {

// A direction: the signs of its way along z, y, x, the axis across which its slices lie, and the
// cells where its steps begin, of which the first may be `along` the row. Each point tells how many
// cells it lies before the step's end, none or one.
struct Course {
    int signs[3], axis, is_along, count, points[4][3];
};
// Half of its step [u], and what each point counts in the mean.
template <class F> struct Parts {
    F half, part[4];
};

// Directions that go through the rows together: the way in y, which of all directions they are,
// their pairs, where their matrices lie, and how many directions of the chunk are before them.
struct Group {
    int y_way, begin, members, first_pair, pairs, matrices, before;
};

// Directions through slices of a color, on the way up or down in z, `way` 1 or -1: `to_middle`
// slices are until the ways meet. Whether what is found `adds` to what others have; whose memory it
// works in; where sums are of numbers and of a field of its own color or of all.
struct Job {
    int color, way, group_from, group_to, slice_from, slice_to, to_middle, adds, lane, sums_at,
        own_bar, shared_bar, piece;
};

// What kernels are given; what one does not use is absent. Changes begin with d_; those of fields
// lie behind them.
template <class F> struct Sweep {
    const F *factors, *beam_factors, *scales, *extinction, *scattering, *densest;
    const F *light_parts[5], *source_parts[5], *bars[5];
    const F *d_factors, *d_scales, *d_light_parts[5], *d_source_parts[5];
    const F *parts, *matrices;
    const int *groups, *courses, *pairs, *order, *ranges, *jobs, *starts;
    int depth, height, width, pitch, margin, colors, most, slab, slabs, directions;
    int extinction_channels, scattering_channels, scratch_rows;
    F *found, *saved, *lines, *scratch, *returning, *e_bar, *sc_bar;
    double* sums;
};

// The same where fields get empty cells around them.
template <class F> struct Surrounded {
    const F *extinction, *scattering;
    F *larger, *tops, *densest;
    int *occupied, *ranges;
    int fields, extinction_channels, scattering_channels, depth, height, width, pitch, margin;
};

// What kernels of cells are given (`sweep_cells.h`).
template <class F> struct CellSweep {
    const F *extinction, *scattering, *scales, *near;
    const F *d_extinction, *d_scattering, *d_scales, *d_near, *parts;
    const int* courses;
    int slice, shape[3], colors, most, extinction_channels, scattering_channels;
    F *light, *d_light, *bar, *q_bars, *returning, *far_bar, *mass_bar, *scattered_bar;
    F *scale_bars, *strength_bars, *inflow_bars;
};

} // namespace ddrecon
