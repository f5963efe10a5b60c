"""Rows of cells along which radiance is followed backward: the adjoint of `rows.py`, in C++.

`rows.FOLLOW_ROWS` kept what scatters and I of all slices of a slab. Of a row and a direction there
are these lines of the last slice, which is the next one that light crosses:

    RETURNING            exp(-depth) source_bar, which goes to the cells where the step began
    FAR, MASS            cotangents of q and of extinction's field at these cells
    SCATTERED            that of scattering's field, where it is another

Where a step meets no medium, nothing returns to what scatters.
"""

from ddrecon.diffusion.rounds.fused.moment_rows import MULTIPLY
from ddrecon.diffusion.rounds.fused.row_steps import (
    BEGINNINGS,
    CARRY,
    DECAYED,
    DIRECTION,
    ENDS,
    SLOPES,
    UPSTREAM,
)
from ddrecon.diffusion.rounds.fused.rows import (
    ACROSS,
    FOLLOW_ROWS,
    GROUP,
    PASS,
    PASS_ALL,
    PLACES,
    RANGE,
    ROW,
)

# Cells whose steps begin at this one. What begins beyond a face of the box took q at the face: then
# there may be two for each slice, row and column.
_TARGETS = """
struct Target { const F* lines; int shift; F part; bool is_real; };
Target targets[16];
int target_count = 0;
for (int i = 0; i < point_count; ++i) {
    const int dk = point[3 * i], dr = point[3 * i + 1], shift = point[3 * i + 2] * x_way;
    for (int a = 0; a <= (dk && s == 0); ++a)
        for (int b = 0; b <= (dr && t == 0); ++b) {
            const F* lines = back_lines[2 * (a ? 0 : dk) + (b ? 0 : dr)];
            if (lines) targets[target_count++] = {lines + own_back_line, shift, part[i], !a && !b};
        }
}
"""
_RETURN_ROWS = (
    """
enum { NEAR, LIGHT, LINES };
enum { RETURNING, FAR, MASS, SCATTERED };
const long long stride = (long long)LINES * most * pitch, places = (slab + 1LL) * height;
const int kinds = SHARES_FIELD ? 3 : 4;
const long long back_stride = (long long)kinds * most * pitch;
const F* own_lines = lines + lane * (places * stride + MARGIN) + MARGIN;
F* own_back = returning + lane * ((height + 2) * back_stride + MARGIN) + MARGIN;
double* own_sums = sums + 3 * sums_at;
F* e_bars = e_bar + (extinction_channels > 1 ? own_bar : shared_bar) * cells;
F* sc_bars = sc_bar + (scattering_channels > 1 ? own_bar : shared_bar) * cells;
for (int s = slice_to - 1; s >= slice_from; --s)
for (int g = group_to - 1; g >= group_from; --g) {"""
    + GROUP
    + "const int ahead = -y_way * width;"
    + MULTIPLY
    + CARRY
    + """
const int k = way > 0 ? s : depth - 1 - s;
for (int t = height - 1; t >= 0; --t) {"""
    + ROW
    + """
    auto line = [&](int slice, int turn, int which, int j) -> const F* {
        const long long place = (slice - slice_from + 1LL) * height + turn;
        return own_lines + place * stride + (LINES * (before + j) + which) * (long long)pitch;
    };
    auto back = [&](int slice, int turn, int which, int j) -> F* {
        const int place = (height - 1 - turn + 2LL * slice) % (height + 2);
        return own_back + place * back_stride + (kinds * (before + j) + which) * (long long)pitch;
    };
    const int own = 3 * POINTERS;
    auto bar_of = [&](int j) -> F* { return scratch_row(own + 5 + j); };
    // E12 transposed: I_bar.
    auto find = [&](int k, const F** rows, F* by) {
        const F* moment = part_of(bars, k);
        rows[0] = moment ? moment + color * cells + at : empty_row;
        by[0] = F(1);
    };
    to_directions(to_weighted_light, One(), find, bar_of, 0, width);
    for (int j = 0; leaving_bar && s == last - 1 && j < members; ++j) {
        const F* row = leaving_bar + face_of(t, begin + j);
        F* bar = bar_of(j);
        for (int c = 0; c < width; ++c) bar[c] += row[c];
    }"""
    + RANGE
    + """
    const F *__restrict e = e_cells + row, *__restrict sc = sc_cells + row;
    F *__restrict source_bars = scratch_row(own + 0), *__restrict passing = scratch_row(own + 1);
    F *__restrict scale_bar = scratch_row(own + 2), *__restrict strength_bar = scratch_row(own + 3);
    F* __restrict inflow_bar = scratch_row(own + 4);
    if (VARIES_NUMBERS)
        for (int c = 0; c < width; ++c) scale_bar[c] = strength_bar[c] = inflow_bar[c] = F(0);
    // Where light went on to, in this slice or the next one, in this row or the next one.
    auto kind = [&](auto* lines, int which) { return lines + which * (long long)pitch; };
    F* back_lines[4];
    for (int i = 0; i < 4; ++i) {
        const int to_s = s + i / 2, to_t = t + i % 2;
        back_lines[i] = to_s < last && to_t < height ? back(to_s, to_t, RETURNING, 0) : nullptr;
    }"""
    + BEGINNINGS
    + """
    for (int j = 0; j < members; ++j) {"""
    + DIRECTION
    + UPSTREAM
    + "const long long own_back_line = kinds * j * (long long)pitch;"
    + _TARGETS
    + """
        F* __restrict bar = bar_of(j);
        F* own_lines_back = back_lines[0] + own_back_line;
        F *__restrict returning_row = kind(own_lines_back, RETURNING);
        F *__restrict far_row = kind(own_lines_back, FAR);
        F *__restrict mass_row = kind(own_lines_back, MASS);
        F *__restrict scattered_row = kind(own_lines_back, SHARES_FIELD ? MASS : SCATTERED);
        const F* near_row = near_lines[0] + own_line;
        for (int which = 0; which < kinds; ++which) {
            F* own = kind(own_lines_back, which);
            own[-1] = own[width] = F(0);
        }
        // What returns from the cells to which light went on, but for those of this row.
        const F *back_from[4];
        for (int i = 0; i < used; ++i) {
            const int place = 2 * point[3 * i] + point[3 * i + 1];
            const bool is_inside = place && back_lines[place];
            back_from[i] = (is_inside ? back_lines[place] + own_back_line : empty_row)
                + point[3 * i + 2] * x_way;
        }"""
    + PASS
    + """"""
    + ENDS
    + DECAYED
    + """
                const F arriving = gather(points, light_from, part, c);
                const F radiance_bar = bar[c];
                // That of the source: what goes on, returns.
                F source_bar;
                if constexpr (decltype(along)::value) source_bar = source_bars[c];
                else source_bar = radiance_bar + gather(points, back_from, part, c);
"""
    + SLOPES
    + """
                mass_row[c] = half_step * (depth_bar * scale)
                    + (SHARES_FIELD ? scattered : F(0));
                if (!SHARES_FIELD) scattered_row[c] = scattered;
                returning_row[c] = is_empty ? source_bar : passed * source_bar;
                far_row[c] = is_empty ? F(0) : line_bar * (phi - psi);
                bar[c] = is_empty ? F(0) : line_bar * psi;
                if (VARIES_NUMBERS) {
                    scale_bar[c] += depth_bar * mass;
                    strength_bar[c] += scattering_depth_bar * scattering_mass;
                    inflow_bar[c] += radiance_bar - source_bar * lost;
                }
            }
        };"""
    + PASS_ALL
    + """
        if (s < entered) {
            // I is what has entered: no step ends here.
            F* __restrict entered_bar = entering_bar + face_of(t, begin + j);
            for (int c = 0; c < width; ++c) {
                F returned = F(0);
                for (int i = 0; i < used; ++i)
                    returned += (used > 1 ? part[i] : F(1)) * back_from[i][c];
                entered_bar[c] = returned;
                bar[c] = returning_row[c] = far_row[c] = mass_row[c] = scattered_row[c] = F(0);
            }
        } else if (is_along) {
            auto begin_back = [&](auto points) {
                INDEPENDENT
                for (int c = 0; c < width; ++c) {
                    const F mass = half_step * (e[c] + gather(points, e_from, part, c));
                    passing[c] = part[0] * decay(scale * mass);
                    source_bars[c] = bar[c] + gather(points, back_from, part, c);
                }
            };
            passing[-1] = passing[width] = F(0);
            if (point_count == 1) begin_back(One());
            else begin_back(Four());
            carry_on(source_bars, passing + x_way, -x_way);
            if (point_count == 1) pass_all(One(), Along());
            else pass_all(Four(), Along());
        }"""
    + ACROSS
    + """
        // By q and by the fields where steps begin.
        F* __restrict e_bar_row = e_bars + at;
        F* __restrict sc_bar_row = sc_bars + at;
        INDEPENDENT
        for (int c = 0; c < width; ++c) {
            e_bar_row[c] += mass_row[c];
            if (!SHARES_FIELD) sc_bar_row[c] += scattered_row[c];
        }
        for (int i = 0; i < target_count; ++i) {
            const Target target = targets[i];
            const F* far = kind(target.lines, FAR) + target.shift;
            const F* mass = kind(target.lines, MASS) + target.shift;
            const F* scattered_from
                = kind(target.lines, SHARES_FIELD ? MASS : SCATTERED) + target.shift;
            INDEPENDENT
            for (int c = 0; c < width; ++c) bar[c] += target.part * far[c];
            const int edge = target.shift > 0 ? 0 : width - 1;
            if (target.shift) bar[edge] += target.part * far[edge - target.shift];
            if (!target.is_real) continue;
            INDEPENDENT
            for (int c = 0; c < width; ++c) {
                e_bar_row[c] += target.part * mass[c];
                if (!SHARES_FIELD) sc_bar_row[c] += target.part * scattered_from[c];
            }
        }
    }
    if (VARIES_NUMBERS) {
        own_sums[0] += total(scale_bar, width);
        own_sums[1] += total(strength_bar, width);
        own_sums[2] += total(inflow_bar, width);
    }
    const bool is_adding = adds || g < group_to - 1;
    F* found_row = found + piece * count * all + color * cells + at;
    to_moments(to_sums, found_row, bar_of, is_adding, F(0), nullptr, at, 0, width);
}
}
"""
)
# Slabs are gone through from the last one on: forward, and then back.
RETURN = f"""{PLACES}
for (int slice_from, slice_to = job_to; slice_to > job_from; slice_to = slice_from) {{
slice_from = slab_of(slice_to - 1);
{{ const bool KEEPS = true; {FOLLOW_ROWS.replace("SAVE_ROW", "")} }}
{{ {_RETURN_ROWS} }}
}}
}}
"""
