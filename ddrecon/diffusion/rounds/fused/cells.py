"""Cells that radiance reaches, one a thread, in C++: sweeps on a GPU (E11, E12).

All directions go on by a slice at a time, each across the axis along which it crosses most cells.
What scatters and I are arrays of all directions, [D, C, z, y, x].
"""

from ddrecon.diffusion.rounds.fused.row_steps import DECAYED, SLOPES

GIVEN = """
    F *extinction, *scattering, *scales, *parts, *near, *light, *bar, *q_bars;
    F *returning, *far_bar, *mass_bar, *scattered_bar, *scale_bars, *strength_bars, *inflow_bars;
    int *steps; int slice, depth, height, width, colors, most;
    int extinction_channels, scattering_channels
"""
"""What kernels of cells are given; what is not used, is none."""
_PLACE = """
const long long cells = (long long)depth * height * width;
// A direction: signs along z, y, x, its axis, how many points; then these.
const int* step = steps + 17 * j;
const F* numbers = parts + 5 * j;
const int n[3] = {depth, height, width};
const int axis = step[3], point_count = step[4];
const F half_step = numbers[0], scale = scales[color], strength = scales[colors + color];
const F inflow = scales[2 * colors + color];
const F* e = extinction + (extinction_channels > 1 ? color * cells : 0);
const F* sc = scattering + (scattering_channels > 1 ? color * cells : 0);
const long long all = ((long long)j * colors + color) * cells;
struct Place { int at[3]; };
auto index = [=](Place p) -> long long {
    return ((long long)p.at[0] * height + p.at[1]) * width + p.at[2];
};
// The place a step's point lies from `p`, against the way of light or with it; within the box?
auto move = [=](Place p, int point, int forward, Place& found) -> bool {
    bool is_inside = true;
    for (int a = 0; a < 3; ++a) {
        found.at[a] = p.at[a] + forward * step[a] * step[5 + 3 * point + a];
        is_inside = is_inside && found.at[a] >= 0 && found.at[a] < n[a];
    }
    return is_inside;
};
"""
# An item is a cell of the slice that its direction has reached.
_SLICE = (
    """
const int color = item / most % colors, j = item / most / colors;
"""
    + _PLACE
    + """
const int plane = (int)(cells / n[axis]), i = item % most;
if (i >= plane || slice >= n[axis]) return;
Place own;
own.at[axis] = step[axis] > 0 ? slice : n[axis] - 1 - slice;
const int columns = axis == 2 ? height : width;
own.at[axis == 0 ? 1 : 0] = i / columns;
own.at[axis == 2 ? 1 : 2] = i % columns;
const long long cell = index(own);
"""
)
# What the step begins with; beyond the box are neither medium nor I, and q is that at its face.
_BEGIN = """
F far = F(0), arriving = F(0), e_far = F(0), sc_far = F(0);
for (int point = 0; point < point_count; ++point) {
    const F part = numbers[1 + point];
    Place from;
    const bool is_inside = move(own, point, -1, from);
    if (is_inside) {
        arriving += part * light[all + index(from)];
        e_far += part * e[index(from)];
        if (!SHARES_FIELD) sc_far += part * sc[index(from)];
    }
    for (int a = 0; a < 3; ++a)
        from.at[a] = from.at[a] < 0 ? 0 : from.at[a] < n[a] ? from.at[a] : n[a] - 1;
    far += part * near[all + index(from)];
}
const bool is_empty = false, is_all_thin = false;
const F near_here = near[all + cell], mass = half_step * (e[cell] + e_far);
const F scattering_mass = SHARES_FIELD ? mass : half_step * (sc[cell] + sc_far);
"""
FOLLOW_CELL = (
    _SLICE
    + _BEGIN
    + DECAYED
    + """
const F source = line_mean * (scattering_mass * strength) - inflow * lost;
light[all + cell] = passed * arriving + source;
"""
)
# Cotangents by q and by the fields at both ends of the step, in `bar`, `far_bar` and `mass_bar`.
RETURN_CELL = (
    _SLICE
    + _BEGIN
    + DECAYED
    + """
const F radiance_bar = bar[all + cell];
F source_bar = radiance_bar;
for (int point = 0; point < point_count; ++point) {
    Place to;
    if (move(own, point, 1, to)) source_bar += numbers[1 + point] * returning[all + index(to)];
}
"""
    + SLOPES
    + """
returning[all + cell] = passed * source_bar;
bar[all + cell] = line_bar * psi;
far_bar[all + cell] = line_bar * (phi - psi);
mass_bar[all + cell] = half_step * (depth_bar * scale) + (SHARES_FIELD ? scattered : F(0));
if (!SHARES_FIELD) scattered_bar[all + cell] = scattered;
if (VARIES_NUMBERS) {
    scale_bars[all + cell] = depth_bar * mass;
    strength_bars[all + cell] = scattering_depth_bar * scattering_mass;
    inflow_bars[all + cell] = radiance_bar - source_bar * lost;
}
"""
)
# To each cell what steps from it have, which began there; an item is a cell of a direction.
COLLECT_CELL = (
    """
const long long number = item, size = (long long)depth * height * width;
const int color = number / size % colors, j = number / size / colors;
"""
    + _PLACE
    + """
const long long cell = number % size;
Place own = {{(int)(cell / width / height), (int)(cell / width % height), (int)(cell % width)}};
F q_bar = bar[all + cell], e_bar = mass_bar[all + cell];
F sc_bar = SHARES_FIELD ? F(0) : scattered_bar[all + cell];
for (int point = 0; point < point_count; ++point) {
    const F part = numbers[1 + point];
    const int* points = step + 5 + 3 * point;
    Place to;
    if (move(own, point, 1, to)) {
        e_bar += part * mass_bar[all + index(to)];
        if (!SHARES_FIELD) sc_bar += part * scattered_bar[all + index(to)];
    }
    // At a face q stands for what is beyond it as well.
    int ends[3];
    for (int a = 0; a < 3; ++a) {
        const int before = own.at[a] - step[a] * points[a];
        ends[a] = before < 0 || before >= n[a];
    }
    for (int choice = 0; choice < 8; ++choice) {
        Place at = to;
        bool is_met = true;
        for (int a = 0; a < 3; ++a) {
            const int stays = choice >> a & 1;
            if (stays) at.at[a] = own.at[a];
            is_met = is_met && stays <= ends[a] && at.at[a] >= 0 && at.at[a] < n[a];
        }
        if (is_met) q_bar += part * far_bar[all + index(at)];
    }
}
q_bars[all + cell] = q_bar;
returning[all + cell] = e_bar;
if (!SHARES_FIELD) light[all + cell] = sc_bar;
"""
)
