#pragma once
#include "ddrecon/kernels/numbers.h"
// What Python gives to kernels of a sweep, by the names of fields (`rows.py`).

namespace ddrecon {

// A direction: its way along x, and the cells from which light comes to a cell, of which the first
// may be `along` the row. Each point tells how many cells it lies before that cell, none or one.
struct Course {
    int x_way, is_along, count, points[4][3];
};
// Its step [u], cells moved along z, y, x, and what each point counts in the mean.
template <class F> struct Parts {
    F step, moved[3], part[4];
};

// Directions that go through the slices together: which of all they are, how many of them go up in
// y, which come first, and how many there are; their units, and where the matrices of these lie.
struct Chunk {
    int begin, ups, members, first_unit, units, matrices;
};

// What kernels are given; what one does not use is absent. Changes begin with d_; those of fields
// lie behind them. A launch does some colors `together`, a chunk of the directions of each piece,
// and one `half` of the slices; what is found `adds` to what others have.
template <class F> struct Sweep {
    const F *factors, *scales, *extinction, *scattering, *gradient, *densest;
    const F *light[2], *source[2], *bars[2];
    const F *d_factors, *d_scales, *d_gradient, *d_light[2], *d_source[2];
    const F *parts, *matrices;
    const int *courses, *units, *order, *ranges, *chunks;
    int depth, height, width, pitch, margin, colors, most, slab, slabs, directions;
    int light_low, source_low, extinction_channels, scattering_channels, scratch_rows, pieces,
        chunk_count;
    int together, color_from, chunk, half, adds;
    F *found, *saved, *lines, *scratch, *returning, *e_bar, *sc_bar, *gradient_bar;
    double* sums;
};

// What a lane does in a launch: a chunk of directions of a color, on the way up or down in z,
// `way` 1 or -1, through slices as it counts them: `to_middle` of them are until both ways meet.
// There each goes on where the other has been, so that no two write to the same numbers at once.
struct Job {
    int lane, color, piece, way, slice_from, slice_to, to_middle;
    Chunk chunk;

    template <class F> INLINE Job(int lane, const Sweep<F>& of) : lane(lane) {
        const int is_down = lane / of.pieces % 2;
        color = of.color_from + lane / of.pieces / 2;
        piece = lane % of.pieces;
        way = is_down ? -1 : 1;
        const int own = (is_down * of.pieces + piece) * of.chunk_count + of.chunk;
        chunk = ((const Chunk*)of.chunks)[own];
        to_middle = (of.depth + is_down) / 2;
        slice_from = of.half ? to_middle : 0;
        slice_to = of.half ? of.depth : to_middle;
    }
};

} // namespace ddrecon
