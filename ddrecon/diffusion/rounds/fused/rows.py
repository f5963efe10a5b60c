"""Rows of cells along which radiance is followed, in C++ (E11, E12).

Slices lie across z or y, so that rows lie along x. Directions that cross the same slices the same
way are a piece; they go through a row one after another, while what they share is at hand. Of all
slices only the last one is kept: `near`, what scatters along a direction, and `radiance`, I less
the light from outside. `upstream` is P, the move from one slice to the next. Where a step meets no
medium, light is only moved: `Empty` stands for that, and is decided for stretches of a row.
"""

MARGIN = 16
"""Cells before each row, and at least so many behind it: rows begin where vectors do."""
PLACES = (
    f"const int MARGIN = {MARGIN};"
    + """
const int* item = given.items.data + 6 * number;
const int axis = item[0], forward = item[1], begin = item[2], count = item[3], color = item[4];
const int width = given.width, wide = given.stretch;
const int slices = axis == 0 ? given.depth : given.height;
const int rows = axis == 0 ? given.height : given.depth;
const long long plane = (long long)given.height * width, cells = given.depth * plane;
const long long slice_step = axis == 0 ? plane : width, row_step = axis == 0 ? width : plane;
// fields have a layer of empty cells around them
const long long sheet = (long long)(given.height + 2) * wide, padded = (given.depth + 2) * sheet;
const long long far_slice = axis == 0 ? sheet : wide, far_row = axis == 0 ? wide : sheet;
const F* extinction = given.extinction.data + (given.extinction_channels > 1 ? color * padded : 0);
const F* scattering = SHARES_FIELD
    ? extinction : given.scattering.data + (given.scattering_channels > 1 ? color * padded : 0);
const F scale = given.numbers.data[color];
const F strength = given.numbers.data[given.colors + color];
const F inflow = given.numbers.data[2 * given.colors + color];
const int lane = given.lanes > 1 ? color : 0;
// What goes together lies together: rows of many arrays would take each other's cache lines.
enum { NEAR, RADIANCE, RETURNING = RADIANCE, FAR_BAR, MASS_BAR, SCATTERED_BAR };
auto row_of = [&](int which, int slice, int j, int row) -> F* {
    const long long line = ((lane * 2LL + (slice & 1)) * given.rows + row) * given.group + j;
    return work.buffers.data + (line * work.slots + which) * wide + MARGIN;
};
const F* nothing = work.nothing.data + MARGIN;
struct Whole { enum { value = 1 }; };
struct Between { enum { value = 0 }; };
struct Filled { enum { value = 0 }; };
struct Empty { enum { value = 1 }; };
// cells of rows that have a medium, `wider` by so many cells, from and to where vectors begin
struct Range { int from, to; };
const int wider_slice = axis == 0 ? given.height + 2 : 1;
const int wider_row = axis == 0 ? 1 : given.height + 2;
auto include = [&](Range& range, int k, int row) {
    const int* own = given.occupied.data + 2 * ((k + 1) * wider_slice + (row + 1) * wider_row);
    range.from = own[0] < range.from ? own[0] : range.from;
    range.to = own[1] > range.to ? own[1] : range.to;
};
auto clamp = [&](int c) { return c < first ? first : c > last ? last : c; };
auto widen = [&](Range range, int by) -> Range {
    if (range.from >= range.to) return {first, first};
    const int end = range.to + by + MARGIN - 1;
    return {clamp((range.from - by) & -MARGIN), clamp(end & -MARGIN)};
};
"""
)
# v where rays were, `here` and `behind` being the rows from which they come
UPSTREAM = """
auto upstream = [&](auto whole, const F* here, const F* behind, int c) -> F {
    if constexpr (decltype(whole)::value) {
        return (row_part > F(0.5) ? behind : here)[c - whole_columns];
    } else {
        const F a = (F(1) - column_part) * here[c] + column_part * here[c - column_sign];
        const F b = (F(1) - column_part) * behind[c] + column_part * behind[c - column_sign];
        return (F(1) - row_part) * a + row_part * b;
    }
};
"""
DIRECTION = """
const F* numbers = given.directions.data + 10 * (begin + j);
const int* signs = given.signs.data + 3 * (begin + j);
const F half = numbers[0], row_part = numbers[1], column_part = numbers[2];
const F w_z = numbers[3], w_y = numbers[4], w_x = numbers[5];
const F by_mean = numbers[6], by_z = numbers[7], by_y = numbers[8], by_x = numbers[9];
const int row_sign = signs[0], column_sign = signs[1];
const int whole_columns = column_part > F(0.5) ? column_sign : 0;
// q + q1 . w
auto light_along = [&](const F* q, const F* q_z, const F* q_y, const F* q_x, int c) -> F {
    return HAS_FLUX ? q[c] + w_z * q_z[c] + w_y * q_y[c] + w_x * q_x[c] : q[c];
};
// where I of a slice and row is kept
auto kept_of = [&](int s, int r) -> long long {
    return (((lane * (long long)slices + s) * rows + r) * given.group + j) * width;
};
"""
# phi, psi and what is lost, of the depth of a step
STEP = """
const F depth = is_empty ? F(0) : scale * mass, passed = is_empty ? F(1) : decay(depth);
const bool is_thin = is_empty || depth < F(0.5);
const F inverse = F(1) / (is_thin ? F(0.5) : depth), series = psi_series(is_thin ? depth : F(0));
const F phi = is_empty ? F(1) : is_thin ? F(1) - depth * series : (F(1) - passed) * inverse;
const F psi = is_empty ? F(0.5) : is_thin ? series : (F(1) - phi) * inverse;
const F lost = depth * phi;
const F line = far * phi + (near - far) * psi;
"""
FOLLOW = (
    PLACES
    + """
const bool is_first = item[5];
for (int s = slice_first; s < slice_last; ++s) {
    // Slice -1 is the first one again: beyond the box q is that at its face, and I is zero.
    const int k = forward > 0 ? (s < 0 ? 0 : s) : slices - 1 - (s < 0 ? 0 : s);
    for (int r = row_first; r < row_last; ++r) {
        const long long at = color * cells + k * slice_step + r * row_step;
        const F* __restrict q = given.light.mean.data + at;
        const F* __restrict q_z = given.light.z.data + (HAS_FLUX ? at : 0);
        const F* __restrict q_y = given.light.y.data + (HAS_FLUX ? at : 0);
        const F* __restrict q_x = given.light.x.data + (HAS_FLUX ? at : 0);
        F* __restrict mean = work.light.mean.data + (KEEPS ? 0 : at);
        F* __restrict flux_z = work.light.z.data + (HAS_FLUX && !KEEPS ? at : 0);
        F* __restrict flux_y = work.light.y.data + (HAS_FLUX && !KEEPS ? at : 0);
        F* __restrict flux_x = work.light.x.data + (HAS_FLUX && !KEEPS ? at : 0);
        if (!KEEPS && is_first && s >= 0) {
            for (int c = first; c < last; ++c) mean[c] = F(0);
            if (HAS_FLUX)
                for (int c = first; c < last; ++c) flux_z[c] = flux_y[c] = flux_x[c] = F(0);
        }
        for (int j = 0; j < count; ++j) {"""
    + DIRECTION
    + UPSTREAM
    + """
            F* __restrict near_row = row_of(NEAR, s, j, r);
            F* __restrict radiance_row = row_of(RADIANCE, s, j, r);
            if (s < 0) {
                INDEPENDENT
                for (int c = first; c < last; ++c) {
                    near_row[c] = light_along(q, q_z, q_y, q_x, c);
                    radiance_row[c] = F(0);
                }
            } else {
                // Beyond the faces of the box are neither medium nor I; q is repeated there.
                const int behind = r - row_sign;
                const bool is_inside = behind >= 0 && behind < rows;
                const F* near_here = row_of(NEAR, s - 1, j, r);
                const F* near_behind = is_inside ? row_of(NEAR, s - 1, j, behind) : near_here;
                const F* radiance_here = row_of(RADIANCE, s - 1, j, r);
                const F* radiance_behind
                    = is_inside ? row_of(RADIANCE, s - 1, j, behind) : nothing;
                const long long there = (k + 1) * far_slice + (r + 1) * far_row + MARGIN;
                const long long before = there - forward * far_slice;
                const F* __restrict e = extinction + there;
                const F* e_here = extinction + before;
                const F* e_behind = e_here - row_sign * far_row;
                const F* __restrict sc = scattering + there;
                const F* sc_here = scattering + before;
                const F* sc_behind = sc_here - row_sign * far_row;
                const long long kept = KEEPS ? kept_of(s, r) : 0;
                F* __restrict arriving_kept = work.arriving.data + kept;
                Range met = {width, 0};
                include(met, k, r);
                include(met, k - forward, r);
                include(met, k - forward, behind);
                met = widen(met, 1);
                auto pass = [&](auto whole, auto empty, int from, int to) {
                    constexpr bool is_empty = decltype(empty)::value;
                    INDEPENDENT
                    for (int c = from; c < to; ++c) {
                        const F near = light_along(q, q_z, q_y, q_x, c);
                        const F far = upstream(whole, near_here, near_behind, c);
                        const F arriving = upstream(whole, radiance_here, radiance_behind, c);
                        const F mass = half * (e[c] + upstream(whole, e_here, e_behind, c));
                        const F scattering_mass = SHARES_FIELD
                            ? mass : half * (sc[c] + upstream(whole, sc_here, sc_behind, c));"""
    + STEP
    + """
                        // Light from outside is there without a medium; I is what differs from it.
                        const F source = line * (scattering_mass * strength) - inflow * lost;
                        const F radiance = is_empty ? arriving : passed * arriving + source;
                        near_row[c] = near;
                        radiance_row[c] = radiance;
                        if (KEEPS) {
                            arriving_kept[c] = arriving;
                        } else {
                            const F whole_radiance = radiance + inflow;
                            mean[c] += by_mean * whole_radiance;
                            if (HAS_FLUX) {
                                flux_z[c] += by_z * whole_radiance;
                                flux_y[c] += by_y * whole_radiance;
                                flux_x[c] += by_x * whole_radiance;
                            }
                        }
                    }
                };
                auto pass_all = [&](auto whole) {
                    pass(whole, Empty(), first, met.from);
                    pass(whole, Filled(), met.from, met.to);
                    pass(whole, Empty(), met.to, last);
                };
                if (signs[2]) pass_all(Whole()); else pass_all(Between());
            }
            if (first == 0) near_row[-1] = near_row[0];
            if (last == width) near_row[width] = near_row[width - 1];
        }
    }
}
"""
)
