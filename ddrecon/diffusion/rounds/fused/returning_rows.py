"""Rows of cells along which radiance is followed backward: the adjoint of `rows.py`, in C++.

Of all slices only the last one is kept, which is the next one that light crosses:

    near                 what scatters along a direction, here of the slice before
    returning            exp(-depth) source_bar, which P^T takes to the slice before
    far_bar, mass_bar    cotangents of q and of the field where rays were one slice earlier

I of all slices was kept by `rows.FOLLOW`. `upstream` is P, `downstream` its transpose P^T. Where
neither this step nor the next meets a medium, nothing returns to what scatters.
"""

from ddrecon.diffusion.rounds.fused.rows import DIRECTION, PLACES, STEP, UPSTREAM

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
        const int two_before = s < 2 ? 0 : s - 2;
        const int k_early = forward > 0 ? two_before : slices - 1 - two_before;
        const long long early = color * cells + k_early * slice_step + r * row_step;
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
    + DIRECTION
    + _DOWNSTREAM
    + """
            // Rows to which rays went on; the last slice has none.
            const int next = r + row_sign;
            const bool is_last = s == slices - 1, is_inside = next >= 0 && next < rows && !is_last;
            auto here_of = [&](int which) -> const F* {
                return is_last ? nothing : row_of(which, s + 1, j, r);
            };
            auto ahead_of = [&](int which) -> const F* {
                return is_inside ? row_of(which, s + 1, j, next) : nothing;
            };
            const F* far_here = here_of(FAR_BAR);
            const F* far_ahead = ahead_of(FAR_BAR);
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
                const F* back_here = here_of(RETURNING);
                const F* back_ahead = ahead_of(RETURNING);
                const F* mass_here = here_of(MASS_BAR);
                const F* mass_ahead = ahead_of(MASS_BAR);
                const F* scattered_here = here_of(SCATTERED_BAR);
                const F* scattered_ahead = ahead_of(SCATTERED_BAR);
                F* __restrict returning_row = row_of(RETURNING, s, j, r);
                F* __restrict far_bar_row = row_of(FAR_BAR, s, j, r);
                F* __restrict mass_bar_row = row_of(MASS_BAR, s, j, r);
                F* __restrict scattered_row = row_of(SCATTERED_BAR, s, j, r);
                const long long there = (k + 1) * far_slice + (r + 1) * far_row + MARGIN;
                const long long before = there - forward * far_slice;
                const F* __restrict e = extinction + there;
                const F* e_here = extinction + before;
                const F* e_behind = e_here - row_sign * far_row;
                const F* __restrict sc = scattering + there;
                const F* sc_here = scattering + before;
                const F* sc_behind = sc_here - row_sign * far_row;
                F* __restrict near_row = row_of(NEAR, s, j, r);
                const int behind = r - row_sign;
                const F* near_here = row_of(NEAR, s - 1, j, r);
                const F* near_behind = behind >= 0 && behind < rows
                    ? row_of(NEAR, s - 1, j, behind) : near_here;
                const F* __restrict arriving_kept = work.arriving.data + kept_of(s, r);
                const F own_part = F(1) - row_part;"""
    + UPSTREAM
    + """
                Range met = {width, 0};
                for (int ahead = -1; ahead <= 1; ++ahead) {
                    include(met, k + ahead * forward, r);
                    if (ahead <= 0) include(met, k + ahead * forward, behind);
                    if (ahead >= 0) include(met, k + ahead * forward, next);
                }
                met = widen(met, 2);
                auto pass = [&](auto whole, auto empty, int from, int to) {
                    constexpr bool is_empty = decltype(empty)::value;
                    INDEPENDENT
                    for (int c = from; c < to; ++c) {
                        const F near = near_row[c], arriving = arriving_kept[c];
                        const F far = upstream(whole, near_here, near_behind, c);
                        const F mass = half * (e[c] + upstream(whole, e_here, e_behind, c));
                        const F scattering_mass = SHARES_FIELD
                            ? mass : half * (sc[c] + upstream(whole, sc_here, sc_behind, c));"""
    + STEP
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
                        const F depth_bar
                            = is_empty ? lost_bar : line_bar * line_slope + lost_bar * passed;
                        const F scattering_depth_bar = source_bar * line;
                        const F scattering_mass_bar = half * (scattering_depth_bar * strength);
                        const F mass_bar = half * (depth_bar * scale)
                            + (SHARES_FIELD ? scattering_mass_bar : F(0));
                        // By q at the near end, and by q where rays will be.
                        if (!is_empty) {
                            const F bar = line_bar * psi
                                + downstream(whole, far_here, far_ahead, all_here, c);
                            q_bar[c] += bar;
                            if (HAS_FLUX) {
                                q_z_bar[c] += w_z * bar;
                                q_y_bar[c] += w_y * bar;
                                q_x_bar[c] += w_x * bar;
                            }
                        }
                        // By the fields, likewise.
                        e_bar[c] += mass_bar
                            + downstream(whole, mass_here, mass_ahead, own_part, c);
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
                        returning_row[c] = is_empty ? source_bar : passed * source_bar;
                        far_bar_row[c] = is_empty ? F(0) : line_bar * (phi - psi);
                        mass_bar_row[c] = mass_bar;
                        near_row[c] = light_along(q, q_z, q_y, q_x, c);
                    }
                };
                auto pass_all = [&](auto whole) {
                    pass(whole, Empty(), first, met.from);
                    pass(whole, Filled(), met.from, met.to);
                    pass(whole, Empty(), met.to, last);
                };
                if (signs[2] && !is_edge) pass_all(Whole()); else pass_all(Between());
                if (first == 0) near_row[-1] = near_row[0];
                if (last == width) near_row[width] = near_row[width - 1];
            }
            if (edge >= first && edge < last) {
                const F bar
                    = column_part * (all_here * far_here[edge] + row_part * far_ahead[edge]);
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
