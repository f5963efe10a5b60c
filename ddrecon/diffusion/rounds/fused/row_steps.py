"""A step of light to a cell of a row, along one direction of a group, in C++ (E11)."""

# Of a direction: the cells where its step begins, and their parts in the mean.
DIRECTION = """
const int* point = points + 16 * (begin + j) + 3;
const int point_count = point[-3], x_way = point[-2], is_along = point[-1];
const int used = point_count == 1 ? 1 : 4;
const F half_step = parts[5 * (begin + j)];
const bool is_thin_row = half_step * deepest < F(0.25);
const F part[4] = {parts[5 * (begin + j) + 1], parts[5 * (begin + j) + 2],
                   parts[5 * (begin + j) + 3], parts[5 * (begin + j) + 4]};
"""
# Lines where steps to a row may begin, of the group's first direction: in this slice or the one
# before, in this row or the one before. Beyond the faces of the box are neither medium nor I; q is
# repeated there.
BEGINNINGS = """
const F *near_lines[4], *light_lines[4];
long long e_back[4];
for (int i = 0; i < 4; ++i) {
    const int dk = i / 2, dr = i % 2;
    const bool is_inside = s >= dk && t >= dr;
    near_lines[i] = line(s >= dk ? s - dk : 0, t >= dr ? t - dr : 0, NEAR, 0);
    light_lines[i] = is_inside ? line(s - dk, t - dr, LIGHT, 0) : nullptr;
    e_back[i] = dk * way * sheet + dr * y_way * pitch;
}
"""
# Those of a direction.
UPSTREAM = """
const F *near_from[4], *light_from[4], *e_from[4], *sc_from[4];
const long long own_line = LINES * j * (long long)pitch;
#pragma clang loop vectorize(disable) unroll(disable)
for (int i = 0; i < used; ++i) {
    const int place = 2 * point[3 * i] + point[3 * i + 1], shift = point[3 * i + 2] * x_way;
    near_from[i] = near_lines[place] + own_line - shift;
    light_from[i] = (light_lines[place] ? light_lines[place] + own_line : empty_row) - shift;
    e_from[i] = e - e_back[place] - shift;
    sc_from[i] = sc - e_back[place] - shift;
}
"""
# The two ends of a step.
ENDS = """
const F near_here = near_row[c], far = gather(points, near_from, part, c);
const F mass = half_step * (e[c] + gather(points, e_from, part, c));
const F scattering_mass
    = SHARES_FIELD ? mass : half_step * (sc[c] + gather(points, sc_from, part, c));
"""
# phi, psi, what passes and what is lost, of the depth of a step; and what of its source reaches its
# end. `is_all_thin`: so are all steps of a stretch.
DECAYED = """
const F depth_of_step = is_empty ? F(0) : scale * mass;
const F kept = is_all_thin ? F(0) : decay(depth_of_step);
const bool is_thin = is_all_thin || depth_of_step < F(0.5);
const F inverse = F(1) / (is_thin ? F(0.5) : depth_of_step);
const F series = psi_series(is_thin ? depth_of_step : F(0));
const F phi = is_empty ? F(1) : is_thin ? F(1) - depth_of_step * series : (F(1) - kept) * inverse;
const F psi = is_empty ? F(0.5) : is_thin ? series : (F(1) - phi) * inverse;
const F lost = depth_of_step * phi, passed = is_all_thin ? F(1) - lost : kept;
const F line_mean = far * phi + (near_here - far) * psi;
"""
# E11 transposed, the source being line times scattering depth: cotangents of the step's numbers.
SLOPES = """
const F slope_series = psi_slope_series(is_thin ? depth_of_step : F(0));
const F psi_slope = is_thin ? slope_series : (phi - F(2) * psi) * inverse;
const F line_bar = source_bar * (scattering_mass * strength);
const F lost_bar = -source_bar * (arriving + inflow);
const F line_slope = far * (psi - phi) + (near_here - far) * psi_slope;
const F depth_bar = is_empty ? lost_bar : line_bar * line_slope + lost_bar * passed;
const F scattering_depth_bar = source_bar * line_mean;
const F scattered = half_step * (scattering_depth_bar * strength);
"""


def _shift(lanes: int, by: int, is_up: bool) -> str:
    """A step of a scan: numbers and what they are multiplied by, moved by so many lanes."""
    moved = [i - by if is_up else i + by for i in range(lanes)]
    places = ", ".join(str(m if 0 <= m < lanes else lanes + i) for i, m in enumerate(moved))
    move = "__builtin_shufflevector({0}, {1}, " + places + ")"
    return f"x += p * {move.format('x', 'none')}; p *= {move.format('p', 'all')};\n"


def _scan(lanes: int, is_up: bool) -> str:
    return "".join(_shift(lanes, 2**k, is_up) for k in range(lanes.bit_length() - 1))


# What comes along a row is carried on from cell to cell, x_c + passed_c x_(c - way) in place: over
# a vector in steps of 1, 2, 4 ... cells.
CARRY = (
    """
auto scan = [](auto x, auto p, auto before, auto up) {
    const decltype(x) none{}, all = none + F(1);
    if constexpr (decltype(up)::value == 1) {
        if constexpr (sizeof(F) == 4) {
"""
    + _scan(16, True)
    + "} else {"
    + _scan(8, True)
    + "} } else if constexpr (sizeof(F) == 4) {"
    + _scan(16, False)
    + "} else {"
    + _scan(8, False)
    + """}
    return x + p * before;
};
auto carry_on = [&](F* values, const F* passed, int way) __attribute__((noinline)) {
    const int whole = width / LANES * LANES;
    F last = F(0);
    auto step = [&](int c) { last = values[c] = values[c] + passed[c] * last; };
    if (way > 0) {
        for (int c = 0; c < whole; c += LANES) {
            const V found = scan(*(const V*)(values + c), *(const V*)(passed + c), last, One());
            *(V*)(values + c) = found;
            last = found[LANES - 1];
        }
        for (int c = whole; c < width; ++c) step(c);
    } else {
        for (int c = width - 1; c >= whole; --c) step(c);
        for (int c = whole - LANES; c >= 0; c -= LANES) {
            const V found = scan(*(const V*)(values + c), *(const V*)(passed + c), last, Two());
            *(V*)(values + c) = found;
            last = found[0];
        }
    }
};
"""
)
