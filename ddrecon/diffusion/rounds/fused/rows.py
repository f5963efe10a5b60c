"""Rows of cells along which radiance is followed, in C++ (E11, E12).

A job goes through the slices across z in the way that its light takes, s counting them, and in each
through the rows, t counting them in the way of a group of directions. A step begins at a mean of up
to four cells, which lie in this slice or the one before, in this row or the one before: wherever a
direction goes, they were done already. Of a row and a direction there are two lines of numbers:
`NEAR`, what scatters along it, and `LIGHT`, I less the light from outside. Lines of the last slice
are kept, each in the place of one that no step needs any more. I before each slab of slices is
saved: for the adjoint, light goes through a slab once more, and lines of all its slices are kept.
A first slice may be another rank's, where I is `entering`; `leaving` is that of the last (E48).

Behind each row there are at least two cells that hold what is beyond its ends. Where a step meets
no medium, light is only moved: `Empty` stands for that, and is decided for stretches of a row. In
`Thin` ones no step is half an optical depth, and what passes needs no exponential.
"""

from ddrecon.diffusion.rounds.fused.jobs import Job
from ddrecon.diffusion.rounds.fused.moment_rows import MULTIPLY
from ddrecon.diffusion.rounds.fused.row_steps import (
    BEGINNINGS,
    CARRY,
    DECAYED,
    DIRECTION,
    ENDS,
    UPSTREAM,
)

MARGIN = 16
"""Cells before an array of lines, whose rows begin where vectors do."""
POINTERS = 64
"""Moments and pairs of a group at most: so many rows are multiplied at once."""
GIVEN = """
    F *factors, *extinction, *scattering, *scales, *parts, *matrices, *lines, *scratch, *nothing;
    F *found, *saved, *returning, *e_bar, *sc_bar, *light_parts[5], *source_parts[5], *bars[5];
    F *densest, *beam_factors, *entering, *leaving, *entering_bar, *leaving_bar; double *sums;
    int *ranges, *jobs, *starts, *groups, *points, *pairs, *order, layers_below, layers_above;
    int depth, height, width, pitch, colors, count, even, most, scratch_rows, slab, slabs;
    int directions, extinction_channels, scattering_channels
"""
"""What kernels of rows are given; what is not used, is none."""
SCRATCH = "lines scratch nothing"
"""Of that what all of them work in."""

_NUMBERS = ", ".join(f"{name} = job[{i}]" for i, name in enumerate(Job._fields))
# For each job of a lane.
PLACES = (
    f"""
const int MARGIN = {MARGIN}, POINTERS = {POINTERS}, JOB = {len(Job._fields)};
for (const int* job = jobs + JOB * starts[item]; job < jobs + JOB * starts[item + 1]; job += JOB) {{
const int {_NUMBERS};
"""
    + """
const long long plane = (long long)height * width, cells = depth * plane, all = colors * cells;
const int odd = count - even;
// fields have a layer of empty cells around them
const long long sheet = (long long)(height + 2) * pitch, padded = (depth + 2) * sheet;
const long long inner = MARGIN + sheet + pitch;
const F* e_cells = extinction + inner + (extinction_channels > 1 ? color * padded : 0);
const F* sc_cells = scattering + inner + (scattering_channels > 1 ? color * padded : 0);
const F scale = scales[color], strength = scales[colors + color];
const F inflow = scales[2 * colors + color];
const F* empty_row = nothing + MARGIN;
// Slices of other ranks, before those that are one's own on this way and after them.
const int entered = way > 0 ? layers_below : layers_above;
const int last = depth - (way > 0 ? layers_above : layers_below);
auto face_of = [&](long long t, int j) { return ((color * directions + j) * height + t) * width; };
// Slabs of slices begin anew in the middle, where the ways meet; of those but the first I is saved.
auto slab_of = [&](int s) { return s - (s < middle ? s : s - middle) % slab; };
auto save_of = [&](int s, int t, int direction) -> long long {
    const int before = s < middle ? 0 : (middle + slab - 1) / slab;
    const long long number = before + (s < middle ? s : s - middle) / slab - 1;
    return (((color * (long long)directions + direction) * slabs + number) * height + t) * width;
};
F* own_scratch = scratch + ((long long)lane * scratch_rows) * pitch;
auto scratch_row = [&](int i) -> F* { return own_scratch + (long long)i * pitch; };
struct Empty { enum { is_empty = 1, is_thin = 1 }; };
struct Thin { enum { is_empty = 0, is_thin = 1 }; };
struct Thick { enum { is_empty = 0, is_thin = 0 }; };
struct One { enum { value = 1 }; };
struct Two { enum { value = 2 }; };
struct Three { enum { value = 3 }; };
struct Four { enum { value = 4 }; };
struct Along { enum { value = 1 }; };
struct Across { enum { value = 0 }; };
// what reaches a cell from those that its step begins at
auto gather = [](auto points, const F* const* from, const F* part, int c) -> F {
    if constexpr (decltype(points)::value == 1) return from[0][c];
    else return part[0] * from[0][c] + part[1] * from[1][c]
              + part[2] * from[2][c] + part[3] * from[3][c];
};
"""
)
# The group of which rows are gone through.
GROUP = """
const int* group = groups + 8 * g;
const int y_way = group[0], begin = group[1], members = group[2], before = group[7];
const int* pair = pairs + 2 * group[3];
const int pair_count = group[4], odd_count = group[5], half = pair_count * even + odd_count * odd;
const F *to_light = matrices + group[6], *to_sums = to_light + half;
const F *to_weighted_light = to_sums + half, *to_weighted_sums = to_weighted_light + half;
"""
# A turn of the loop over rows: where row t lies, in fields and in those with a layer around them.
ROW = """
    const int r = y_way > 0 ? t : height - 1 - t;
    const long long at = k * plane + (long long)r * width, row = k * sheet + (long long)r * pitch;
"""
# Where steps to its cells meet a medium, and how deep that is at most.
RANGE = """
    const int* range = ranges + 4 * (k * height + r);
    const int from = range[0], to = range[1];
    const F deepest = scale * densest[k * height + r];
"""
# A loop over cells of a row: steps that begin at so many `points`, in a stretch of such `matter`.
PASS = """
        auto pass = [&](auto points, auto along, auto matter, int from, int to) {
            constexpr bool is_empty = decltype(matter)::is_empty;
            constexpr bool is_all_thin = decltype(matter)::is_thin;
            INDEPENDENT
            for (int c = from; c < to; ++c) {"""
# All cells of a row. Where they are not `is_along`, one loop does each stretch.
PASS_ALL = """
        auto pass_all = [&](auto points, auto along) {
            pass(points, along, Empty(), 0, from);
            if (is_thin_row) pass(points, along, Thin(), from, to);
            else pass(points, along, Thick(), from, to);
            pass(points, along, Empty(), to, width);
        };
"""
ACROSS = """
        else if (point_count == 1) pass_all(One(), Across());
        else pass_all(Four(), Across());
"""
FOLLOW_ROWS = (
    """
enum { NEAR, LIGHT, LINES };
const long long stride = LINES * most * pitch;
const long long places = KEEPS ? (slab + 1LL) * height : height + 2;
F* own_lines = lines + lane * (places * stride + MARGIN) + MARGIN;
const int slice_before = KEEPS && slice_from > 0 ? slice_from - 1 : slice_from;
for (int s = slice_before; s < slice_to; ++s) for (int g = group_from; g < group_to; ++g) {"""
    + GROUP
    + "const int ahead = y_way * width;"
    + MULTIPLY
    + CARRY
    + """
const int k = way > 0 ? s : depth - 1 - s;
for (int t = 0; t < height; ++t) {"""
    + ROW
    + """
    auto line = [&](int slice, int turn, int which, int j) -> F* {
        const long long place = KEEPS
            ? (slice - slice_from + 1LL) * height + turn
            : (turn + 2LL * (depth - slice)) % (height + 2);
        return own_lines + place * stride + (LINES * (before + j) + which) * (long long)pitch;
    };
    auto near_of = [&](int j) -> F* { return line(s, t, NEAR, j); };
    auto light_of = [&](int j) -> F* { return line(s, t, LIGHT, j); };
    // Where steps meet a medium, and where what scatters is asked for."""
    + RANGE
    + """
    const int near_begin = KEEPS ? 0 : range[2], near_end = KEEPS ? width : range[3];
    auto find = [&](int k, const F** rows, F* by) {
        find_scattering(color * cells + at, k, rows, by);
    };
    to_directions(to_light, Two(), find, near_of, near_begin, near_end);
    const F *__restrict e = e_cells + row, *__restrict sc = sc_cells + row;
    F* __restrict carried = scratch_row(3 * POINTERS);"""
    + BEGINNINGS
    + """
    for (int j = 0; j < members; ++j) {"""
    + DIRECTION
    + """
        F *near_row = near_of(j), *__restrict light_row = light_of(j);
        light_row[-1] = light_row[width] = F(0);
        if (x_way > 0) near_row[-1] = near_row[0];
        else near_row[width] = near_row[width - 1];
        if (s < entered || (KEEPS && s < slice_from)) {
            const F* row = s < entered ? entering + face_of(t, begin + j)
                                       : saved + save_of(s + 1, t, begin + j);
            for (int c = 0; c < width; ++c) light_row[c] = row[c];
            continue;
        }"""
    + UPSTREAM
    + PASS
    + """
                const F arriving = gather(points, light_from, part, c);
                if constexpr (is_empty) {
                    light_row[c] = arriving;
                    if (decltype(along)::value) carried[c] = part[0];
                } else {"""
    + ENDS
    + DECAYED
    + """
                    // Light from outside is there without a medium; I is what differs from it.
                    const F source = line_mean * (scattering_mass * strength) - inflow * lost;
                    light_row[c] = passed * arriving + source;
                    if (decltype(along)::value) carried[c] = part[0] * passed;
                }
            }
        };"""
    + PASS_ALL
    + """
        if (is_along) {
            // What comes along the row itself is carried on cell by cell.
            for (int i = 0; i < used; ++i)
                if (!point[3 * i] && !point[3 * i + 1]) light_from[i] = empty_row;
            if (point_count == 1) pass_all(One(), Along());
            else pass_all(Four(), Along());
            carry_on(light_row, carried, x_way);
        }"""
    + ACROSS
    + """
        SAVE_ROW
    }
    if (KEEPS) continue;
    F* found_row = found + piece * count * all + color * cells + at;
    const bool is_adding = adds || g > group_from;
    // the change of the first two moments of light
    to_moments(to_weighted_sums, found_row, light_of, is_adding, piece > 0 ? F(0) : inflow,
               piece > 0 ? nullptr : light_parts, color * cells + at, 0, width);
}
}
"""
)
_SAVE_ROW = """
        if (saved && s + 1 < depth && slab_of(s + 1) == s + 1) {
            F* row = saved + save_of(s + 1, t, begin + j);
            for (int c = 0; c < width; ++c) row[c] = light_row[c];
        }
        if (leaving && s == last - 1) {
            F* row = leaving + face_of(t, begin + j);
            for (int c = 0; c < width; ++c) row[c] = light_row[c];
        }
"""
_ROWS = FOLLOW_ROWS.replace("SAVE_ROW", _SAVE_ROW)
FOLLOW = f"{PLACES} const int slice_from = job_from, slice_to = job_to; {_ROWS} }}"
