"""Rows of cells along which radiance is followed, or followed backward, in C++ (E11, E12).

Slices lie across z or y, so that rows lie along x. Directions that cross the same slices the same
way are a piece; they go through a row one after another, while what they share is at hand. Between
slices only the last one is kept, with an empty cell before and behind each row:

    near, radiance       what scatters along a direction, and I less the light from outside
    returning            exp(-depth) source_bar, which P^T takes to the slice before
    far_bar, mass_bar    cotangents of q and of the field where rays were one slice earlier

`upstream` is P, `downstream` its transpose P^T.
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
auto row_of = [&](const wp::array_t<F>& buffer, int slice, int j, int row) -> F* {
    const long long line = ((lane * 2LL + (slice & 1)) * given.group + j) * given.rows + row;
    return buffer.data + line * wide + MARGIN;
};
const F* nothing = work.nothing.data + MARGIN;
struct Whole { enum { value = 1 }; };
struct Between { enum { value = 0 }; };
"""
)
# v where rays were, `here` and `behind` being the rows from which they come
_UPSTREAM = """
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
_DOWNSTREAM = """
auto downstream = [&](auto whole, const F* here, const F* ahead, F here_part, int c) -> F {
    if constexpr (decltype(whole)::value) {
        return (row_part > F(0.5) ? ahead : here)[c + whole_columns];
    } else {
        const F a = (F(1) - column_part) * here[c] + column_part * here[c + column_sign];
        const F b = (F(1) - column_part) * ahead[c] + column_part * ahead[c + column_sign];
        return here_part * a + row_part * b;
    }
};
"""
_DIRECTION = """
const F* numbers = given.directions.data + 10 * (begin + j);
const int* signs = given.signs.data + 3 * (begin + j);
const F half = numbers[0], row_part = numbers[1], column_part = numbers[2];
const F w_z = numbers[3], w_y = numbers[4], w_x = numbers[5];
const F by_mean = numbers[6], by_z = numbers[7], by_y = numbers[8], by_x = numbers[9];
const int row_sign = signs[0], column_sign = signs[1];
const int whole_columns = column_part > F(0.5) ? column_sign : 0;
"""
# phi, psi and what is lost, of the depth of a step
_STEP = """
const F depth = scale * mass, passed = decay(depth);
const bool is_thin = depth < F(0.5);
const F inverse = F(1) / (is_thin ? F(0.5) : depth), series = psi_series(is_thin ? depth : F(0));
const F phi = is_thin ? F(1) - depth * series : (F(1) - passed) * inverse;
const F psi = is_thin ? series : (F(1) - phi) * inverse;
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
    + _DIRECTION
    + _UPSTREAM
    + """
            F* __restrict near_row = row_of(work.near, s, j, r);
            F* __restrict radiance_row = row_of(work.radiance, s, j, r);
            if (s < 0) {
                INDEPENDENT
                for (int c = first; c < last; ++c) {
                    near_row[c] = HAS_FLUX ? q[c] + w_z * q_z[c] + w_y * q_y[c] + w_x * q_x[c] : q[c];
                    radiance_row[c] = F(0);
                }
            } else {
                // Beyond the faces of the box are neither medium nor I; q is repeated there.
                const int behind = r - row_sign;
                const bool is_inside = behind >= 0 && behind < rows;
                const F* near_here = row_of(work.near, s - 1, j, r);
                const F* near_behind = is_inside ? row_of(work.near, s - 1, j, behind) : near_here;
                const F* radiance_here = row_of(work.radiance, s - 1, j, r);
                const F* radiance_behind = is_inside ? row_of(work.radiance, s - 1, j, behind) : nothing;
                const long long there = (k + 1) * far_slice + (r + 1) * far_row + MARGIN;
                const long long before = there - forward * far_slice;
                const F* __restrict e = extinction + there;
                const F* e_here = extinction + before;
                const F* e_behind = e_here - row_sign * far_row;
                const F* __restrict sc = scattering + there;
                const F* sc_here = scattering + before;
                const F* sc_behind = sc_here - row_sign * far_row;
                const long long kept = ((lane * (long long)given.group + j) * slices + s) * rows + r;
                F* __restrict arriving_kept = work.arriving.data + (KEEPS ? kept * width : 0);
                auto pass = [&](auto whole) {
                    INDEPENDENT
                    for (int c = first; c < last; ++c) {
                        const F near = HAS_FLUX
                            ? q[c] + w_z * q_z[c] + w_y * q_y[c] + w_x * q_x[c] : q[c];
                        const F far = upstream(whole, near_here, near_behind, c);
                        const F arriving = upstream(whole, radiance_here, radiance_behind, c);
                        const F mass = half * (e[c] + upstream(whole, e_here, e_behind, c));
                        const F scattering_mass = SHARES_FIELD
                            ? mass : half * (sc[c] + upstream(whole, sc_here, sc_behind, c));"""
    + _STEP
    + """
                        // Light from outside is there without a medium; I is what differs from it.
                        const F source = line * (scattering_mass * strength) - inflow * lost;
                        const F radiance = passed * arriving + source;
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
                if (signs[2]) pass(Whole()); else pass(Between());
            }
            if (first == 0) near_row[-1] = near_row[0];
            if (last == width) near_row[width] = near_row[width - 1];
        }
    }
}
"""
)
RETURN = (
    PLACES
    + """
for (int s = slice_last - 1; s >= slice_first; --s) {
    // Slice -1 is the first one again, which receives what its q was repeated for.
    const int k = forward > 0 ? (s < 0 ? 0 : s) : slices - 1 - (s < 0 ? 0 : s);
    for (int r = row_first; r < row_last; ++r) {
        const long long inner = k * slice_step + r * row_step, at = color * cells + inner;
        const long long at_flux = HAS_FLUX ? at : 0;
        // What scatters two slices before, which takes the place of this slice's in the buffer.
        const int before_last = forward > 0 ? (s < 2 ? 0 : s - 2) : slices - 1 - (s < 2 ? 0 : s - 2);
        const long long early = color * cells + before_last * slice_step + r * row_step;
        const F* __restrict q = given.light.mean.data + early;
        const F* __restrict q_z = given.light.z.data + (HAS_FLUX ? early : 0);
        const F* __restrict q_y = given.light.y.data + (HAS_FLUX ? early : 0);
        const F* __restrict q_x = given.light.x.data + (HAS_FLUX ? early : 0);
        const F* __restrict mean_bar = bars.mean.data + at;
        const F* __restrict z_bar = bars.z.data + at_flux;
        const F* __restrict y_bar = bars.y.data + at_flux;
        const F* __restrict x_bar = bars.x.data + at_flux;
        F* __restrict q_bar = work.light.mean.data + at;
        F* __restrict q_z_bar = work.light.z.data + at_flux;
        F* __restrict q_y_bar = work.light.y.data + at_flux;
        F* __restrict q_x_bar = work.light.x.data + at_flux;
        F* __restrict e_bar = work.extinction.data
            + (work.extinction_channels > 1 ? color * cells : 0) + inner;
        F* __restrict sc_bar = work.scattering.data
            + (SHARES_FIELD ? 0 : (work.scattering_channels > 1 ? color * cells : 0) + inner);
        const long long sum_row = (color * (long long)given.rows + r) * width;
        const long long sums = (long long)given.colors * given.rows * width;
        F* __restrict scale_bar = work.numbers.data + sum_row;
        F* __restrict strength_bar = work.numbers.data + sums + sum_row;
        F* __restrict inflow_bar = work.numbers.data + 2 * sums + sum_row;
        if (item[5] && s >= 0) {
            for (int c = first; c < last; ++c) q_bar[c] = F(0);
            if (HAS_FLUX)
                for (int c = first; c < last; ++c) q_z_bar[c] = q_y_bar[c] = q_x_bar[c] = F(0);
        }
        for (int j = 0; j < count; ++j) {"""
    + _DIRECTION
    + _DOWNSTREAM
    + """
            // Rows to which rays went on; the last slice has none.
            const int next = r + row_sign;
            const bool is_last = s == slices - 1, is_inside = next >= 0 && next < rows && !is_last;
            auto here_of = [&](const wp::array_t<F>& buffer) -> const F* {
                return is_last ? nothing : row_of(buffer, s + 1, j, r);
            };
            auto ahead_of = [&](const wp::array_t<F>& buffer) -> const F* {
                return is_inside ? row_of(buffer, s + 1, j, next) : nothing;
            };
            const F* far_here = here_of(work.far_bar);
            const F* far_ahead = ahead_of(work.far_bar);
            // q at an edge stands for what is beyond it as well.
            const bool is_edge = r == (row_sign > 0 ? 0 : rows - 1);
            const int edge = column_sign > 0 ? 0 : width - 1;
            const F all_here = is_edge ? F(1) : F(1) - row_part;
            if (s < 0) {
                INDEPENDENT
                for (int c = first; c < last; ++c) {
                    const F bar = downstream(Between(), far_here, far_ahead, all_here, c);
                    q_bar[c] += bar;
                    if (HAS_FLUX) {
                        q_z_bar[c] += w_z * bar;
                        q_y_bar[c] += w_y * bar;
                        q_x_bar[c] += w_x * bar;
                    }
                }
            } else {
                const F* back_here = here_of(work.returning);
                const F* back_ahead = ahead_of(work.returning);
                const F* mass_here = here_of(work.mass_bar);
                const F* mass_ahead = ahead_of(work.mass_bar);
                const F* scattered_here = here_of(work.scattering_mass_bar);
                const F* scattered_ahead = ahead_of(work.scattering_mass_bar);
                F* __restrict returning_row = row_of(work.returning, s, j, r);
                F* __restrict far_bar_row = row_of(work.far_bar, s, j, r);
                F* __restrict mass_bar_row = row_of(work.mass_bar, s, j, r);
                F* __restrict scattered_row = row_of(work.scattering_mass_bar, s, j, r);
                const long long there = (k + 1) * far_slice + (r + 1) * far_row + MARGIN;
                const long long before = there - forward * far_slice;
                const F* __restrict e = extinction + there;
                const F* e_here = extinction + before;
                const F* e_behind = e_here - row_sign * far_row;
                const F* __restrict sc = scattering + there;
                const F* sc_here = scattering + before;
                const F* sc_behind = sc_here - row_sign * far_row;
                const long long kept = ((lane * (long long)given.group + j) * slices + s) * rows + r;
                F* __restrict near_row = row_of(work.near, s, j, r);
                const int behind = r - row_sign;
                const F* near_here = row_of(work.near, s - 1, j, r);
                const F* near_behind = behind >= 0 && behind < rows
                    ? row_of(work.near, s - 1, j, behind) : near_here;
                const F* __restrict arriving_kept = work.arriving.data + kept * width;
                const F own_part = F(1) - row_part;"""
    + _UPSTREAM
    + """
                auto pass = [&](auto whole, auto whole_far) {
                    INDEPENDENT
                    for (int c = first; c < last; ++c) {
                        const F near = near_row[c], arriving = arriving_kept[c];
                        const F far = upstream(whole, near_here, near_behind, c);
                        const F mass = half * (e[c] + upstream(whole, e_here, e_behind, c));
                        const F scattering_mass = SHARES_FIELD
                            ? mass : half * (sc[c] + upstream(whole, sc_here, sc_behind, c));"""
    + _STEP
    + """
                        const F slope_series = psi_slope_series(is_thin ? depth : F(0));
                        const F psi_slope = is_thin ? slope_series : (phi - F(2) * psi) * inverse;
                        // E12 transposed: I_bar; then that of the source: what goes on, returns.
                        F radiance_bar = by_mean * mean_bar[c];
                        if (HAS_FLUX)
                            radiance_bar += by_z * z_bar[c] + by_y * y_bar[c] + by_x * x_bar[c];
                        const F source_bar = radiance_bar
                            + downstream(whole, back_here, back_ahead, own_part, c);
                        // E11 transposed: the source is line times scattering depth.
                        const F line_bar = source_bar * (scattering_mass * strength);
                        const F lost_bar = -source_bar * (arriving + inflow);
                        const F line_slope = far * (psi - phi) + (near - far) * psi_slope;
                        const F depth_bar = line_bar * line_slope + lost_bar * passed;
                        const F scattering_depth_bar = source_bar * line;
                        const F scattering_mass_bar = half * (scattering_depth_bar * strength);
                        const F mass_bar
                            = half * (depth_bar * scale) + (SHARES_FIELD ? scattering_mass_bar : F(0));
                        // By q at the near end, and by q where rays will be.
                        const F bar = line_bar * psi
                            + downstream(whole_far, far_here, far_ahead, all_here, c);
                        q_bar[c] += bar;
                        if (HAS_FLUX) {
                            q_z_bar[c] += w_z * bar;
                            q_y_bar[c] += w_y * bar;
                            q_x_bar[c] += w_x * bar;
                        }
                        // By the fields, likewise.
                        e_bar[c] += mass_bar + downstream(whole, mass_here, mass_ahead, own_part, c);
                        if (!SHARES_FIELD) {
                            sc_bar[c] += scattering_mass_bar
                                + downstream(whole, scattered_here, scattered_ahead, own_part, c);
                            scattered_row[c] = scattering_mass_bar;
                        }
                        if (VARIES_NUMBERS) {
                            scale_bar[c] += depth_bar * mass;
                            strength_bar[c] += scattering_depth_bar * scattering_mass;
                            inflow_bar[c] += radiance_bar - source_bar * lost;
                        }
                        returning_row[c] = passed * source_bar;
                        far_bar_row[c] = line_bar * (phi - psi);
                        mass_bar_row[c] = mass_bar;
                        near_row[c] = HAS_FLUX
                            ? q[c] + w_z * q_z[c] + w_y * q_y[c] + w_x * q_x[c] : q[c];
                    }
                };
                if (!signs[2]) pass(Between(), Between());
                else if (is_edge) pass(Whole(), Between());
                else pass(Whole(), Whole());
                if (first == 0) near_row[-1] = near_row[0];
                if (last == width) near_row[width] = near_row[width - 1];
            }
            if (edge >= first && edge < last) {
                const F bar = column_part * (all_here * far_here[edge] + row_part * far_ahead[edge]);
                q_bar[edge] += bar;
                if (HAS_FLUX) {
                    q_z_bar[edge] += w_z * bar;
                    q_y_bar[edge] += w_y * bar;
                    q_x_bar[edge] += w_x * bar;
                }
            }
        }
    }
}
"""
)
