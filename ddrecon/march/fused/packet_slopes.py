"""C++ of packets of rays: how values at nodes change with where these lie, and so with the rays.

As of `numerics.third_order`: beyond the outermost centers of cells values stay, and on a cell's
center, a kink, the slope is the mean of both sides.
"""

from ddrecon.numerics.third_order import KINK

SIDE = 4
"""How many times as far as a kink reaches a place is looked at from one of its sides."""
SLOPES = (
    f"""
const F KINK = F({KINK}) * (sizeof(F) == 8 ? F({2.0**-52!r}) : F({2.0**-23!r}));
const F SIDE = F({SIDE});
"""
    + """
// A place on a line, on a kink as seen from one side; `live` is 0 beyond the outermost centers.
struct Side { Place at; V live, excess_slope; };
auto kink_at = [&](V y, int size) -> M {
    const V held = P::least(P::most(y, P::all(F(-2))), P::all(F(size + 1)));
    return P::size(y - P::real(P::whole(held + F(0.5)))) < P::all(KINK * F(size));
};
auto at_side = [&](V y, int size, F side) -> Side {
    const V none = P::all(F(0)), end = P::all(F(size - 1));
    const V seen = P::pick(kink_at(y, size), y + side * SIDE * KINK * F(size), y);
    Side q;
    q.at = Place::at(seen, size);
    q.at.a = P::least(P::most(y, none), end) - P::real(q.at.i);
    q.live = P::pick((seen > none) & (seen < end), P::all(F(1)), none);
    q.at.excess = q.live * (F(0.5) * q.at.a * (F(1) - q.at.a));
    q.excess_slope = q.live * (F(0.5) - q.at.a);
    return q;
};
struct Slope {
    V z, y, x, bend_z, bend_y, bend_x;
    static INLINE Slope mean(const Slope& a, const Slope& b) {
        const V half = P::all(F(0.5));
        return {half * (a.z + b.z), half * (a.y + b.y), half * (a.x + b.x),
                half * (a.bend_z + b.bend_z), half * (a.bend_y + b.bend_y),
                half * (a.bend_x + b.bend_x)};
    }
};
auto slope_from = [&](const F* f, const Side& row, const Side& column, bool is_bent) -> Slope {
    const Place &y = row.at, &x = column.at;
    const Corners q = Corners::of(y, x, lines);
    const V f00 = P::gather(f, q.at00), f01 = P::gather(f, q.at01);
    const V f10 = P::gather(f, q.at10), f11 = P::gather(f, q.at11);
    // Between values in columns i and j, or rows: what lies a part of the way.
    auto along = [](V one, V other, V a) -> V { return one + a * (other - one); };
    Slope s;
    s.y = row.live * along(f10 - f00, f11 - f01, x.a);
    s.x = column.live * along(f01 - f00, f11 - f10, y.a);
    s.z = s.bend_z = s.bend_y = s.bend_x = P::all(F(0));
    if (!is_bent) return s;
    // Second differences along y, and along x, about each of the four cells.
    const I ym = y.m * lines.row, yi = y.i * lines.row, yj = y.j * lines.row;
    const I yp = y.p * lines.row, xm = x.m * lines.column, xi = x.i * lines.column;
    const I xj = x.j * lines.column, xp = x.p * lines.column;
    const V y00 = P::gather(f, ym + xi) - F(2) * f00 + f10;
    const V y01 = P::gather(f, ym + xj) - F(2) * f01 + f11;
    const V y10 = f00 - F(2) * f10 + P::gather(f, yp + xi);
    const V y11 = f01 - F(2) * f11 + P::gather(f, yp + xj);
    const V x00 = P::gather(f, yi + xm) - F(2) * f00 + f01;
    const V x01 = f00 - F(2) * f01 + P::gather(f, yi + xp);
    const V x10 = P::gather(f, yj + xm) - F(2) * f10 + f11;
    const V x11 = f10 - F(2) * f11 + P::gather(f, yj + xp);
    const V along_y = along(along(y00, y01, x.a), along(y10, y11, x.a), y.a);
    const V along_x = along(along(x00, x01, x.a), along(x10, x11, x.a), y.a);
    s.bend_y = row.live * (row.excess_slope * along_y + y.excess * along(y10 - y00, y11 - y01, x.a)
                           + x.excess * along(x10 - x00, x11 - x01, x.a));
    s.bend_x = column.live * (column.excess_slope * along_x
                              + x.excess * along(x01 - x00, x11 - x10, y.a)
                              + y.excess * along(y01 - y00, y11 - y10, y.a));
    return s;
};
// Between slices.
auto slope_between = [&](const F* f, const Side& layer, const Side& row, const Side& column,
                         bool is_bent) -> Slope {
    const Layers layers = Layers::of(layer.at);
    // How what a value counts changes along z.
    const V w1 = layer.at.a, w0 = F(1) - w1, e = layer.at.excess, by_e = layer.excess_slope;
    const V none = P::all(F(0)), one = P::all(F(1)), linear[4] = {none, -one, one, none};
    const V across[4] = {by_e * w0 - e, by_e * (w1 - F(2) * w0) + F(3) * e,
                         by_e * (w0 - F(2) * w1) - F(3) * e, by_e * w1 + e};
    Slope total = {none, none, none, none, none, none};
    for (int i = 0; i < 4; ++i) {
        if (Layers::is_outer(i) && !is_bent) continue;
        const bool bends = is_bent && !Layers::is_outer(i);
        Side in_slice = row;
        in_slice.at = Place::behind(row.at, layers.at[i] * lines.rows);
        const Corners q = Corners::of(in_slice.at, column.at, lines);
        V bend = none;
        const V v = bends ? Values::curved(f, q, in_slice.at, column.at, lines, bend)
                          : Values::linear(f, q);
        const Slope s = slope_from(f, in_slice, column, bends);
        const V counts = layers.linear[i], bent = layers.across[i];
        total.z += layer.live * (linear[i] * v);
        total.bend_z += layer.live * (linear[i] * bend + across[i] * v);
        total.y += counts * s.y;
        total.x += counts * s.x;
        total.bend_y += counts * s.bend_y + bent * s.y;
        total.bend_x += counts * s.bend_x + bent * s.x;
    }
    return total;
};
// Slopes at node n, at distance s, of channels `from` to before `to`: each is handed to `take`.
auto take_slopes = [&](int n, V s, int from, int to, auto take) {
    const V y = ray.o1 + s * ray.d1, x = ray.o2 + s * ray.d2;
    const V z = ray.o0 + s * ray.d0, none = P::all(F(0)), one = P::all(F(1));
    M is_kink = kink_at(y, lines.rows) | kink_at(x, lines.columns);
    if (!IS_SLICED) is_kink = is_kink | kink_at(z, depth);
    const bool has_kink = !P::every(P::pick(is_kink, one, none) == none);
    struct Seen { Side layer, row, column; };
    auto seen_from = [&](F side) -> Seen {
        Seen seen;
        if (!IS_SLICED) seen.layer = at_side(z, depth, side);
        seen.row = at_side(y, lines.rows, side);
        seen.column = at_side(x, lines.columns, side);
        return seen;
    };
    const Seen here = seen_from(has_kink ? F(-1) : F(0)), next = seen_from(F(1));
    for (int c = from; c < to; ++c) {
        const F* field = fields[c] + (IS_SLICED ? slice(n) : 0);
        const bool is_bent = c >= FIRST_MASS && c < FIRST_MASS + MASSES;
        auto slope_of = [&](const Seen& seen) -> Slope {
            return IS_SLICED ? slope_from(field, seen.row, seen.column, is_bent)
                             : slope_between(field, seen.layer, seen.row, seen.column, is_bent);
        };
        const Slope slope = slope_of(here);
        take(c, has_kink ? Slope::mean(slope, slope_of(next)) : slope);
    }
};
"""
)
MOVE = """
V o_bar[3] = {none, none, none}, d_bar[3] = {none, none, none}, near_bar = none, far_bar = none;
// What the bars of node n are for its ray: of its values and their bends, and of its distance.
auto move = [&](int n, const Node& node, const V* v_bar, const V* bend_bar, V t_bar) {
    V z_bar = none, y_bar = none, x_bar = none;
    take_slopes(n, node.s, 0, CHANNELS, [&](int c, const Slope& slope) {
        if (!IS_SLICED) z_bar += v_bar[c] * slope.z;
        y_bar += v_bar[c] * slope.y;
        x_bar += v_bar[c] * slope.x;
        const int k = c - FIRST_MASS;
        if (k >= 0 && k < MASSES) {
            if (!IS_SLICED) z_bar += bend_bar[k] * slope.bend_z;
            y_bar += bend_bar[k] * slope.bend_y;
            x_bar += bend_bar[k] * slope.bend_x;
        }
    });
    if (IS_SLICED) {
        // A node held at a face of the box moves with the face.
        const M is_near = node.s <= ray.near, is_far = node.s >= ray.far;
        near_bar += P::pick(is_near, t_bar, none);
        far_bar += P::pick(is_near, none, P::pick(is_far, t_bar, none));
        const V s_bar = P::pick(is_near | is_far, none, t_bar) + y_bar * ray.d1 + x_bar * ray.d2;
        o_bar[0] -= s_bar / ray.d0;
        d_bar[0] -= s_bar * node.s / ray.d0;
    } else {
        const V s_bar = t_bar + z_bar * ray.d0 + y_bar * ray.d1 + x_bar * ray.d2;
        near_bar += s_bar * (F(1) - planes[n]);
        far_bar += s_bar * planes[n];
        o_bar[0] += z_bar;
        d_bar[0] += z_bar * node.s;
    }
    o_bar[1] += y_bar;
    d_bar[1] += y_bar * node.s;
    o_bar[2] += x_bar;
    d_bar[2] += x_bar * node.s;
};
auto store_ray = [&]() {
    const int y = is_turned ? 2 : 1, x = 3 - y;
    const V bars[8] = {o_bar[0], o_bar[y], o_bar[x], d_bar[0], d_bar[y], d_bar[x],
                       near_bar, far_bar};
    for (int l = 0; l < LANES && begin + l <= last; ++l)
        for (int k = 0; k < 8; ++k) rays_bar[8LL * (begin + l) + k] = P::lane(bars[k], l);
};
"""
"""The adjoint: before the walk back, which has `rays_bar`."""
STAY = """
auto move = [](auto&&...) {};
auto store_ray = []() {};
"""
"""The same where rays stay."""
MOVE_TANGENT = """
struct { V o0, o1, o2, d0, d1, d2, near, far; } d_ray;
{
    V d[8];
    for (int k = 0; k < 8; ++k) d[k] = P::load(d_rays + k, begin, 8, last);
    const int y = is_turned ? 2 : 1, x = 3 - y;
    d_ray = {d[0], d[y], d[x], d[3], d[3 + y], d[3 + x], d[6], d[7]};
}
// The change of a node's distances.
auto move_node = [&](int n, const Node& node, Node& change) {
    if (!IS_SLICED) {
        change.s = change.t = d_ray.near + planes[n] * (d_ray.far - d_ray.near);
        return;
    }
    change.s = -(d_ray.o0 + node.s * d_ray.d0) / ray.d0;
    // A node held at a face of the box moves with the face.
    const V moved = P::pick(node.s >= ray.far, d_ray.far, change.s);
    change.t = P::pick(node.s <= ray.near, d_ray.near, moved);
};
// And what its values change by, as it moves in the slice.
auto move_values = [&](Node& change, int n, int from, int to) {
    const V s = distance(n);
    const V d_y = d_ray.o1 + s * d_ray.d1 + change.s * ray.d1;
    const V d_x = d_ray.o2 + s * d_ray.d2 + change.s * ray.d2;
    const V d_z = d_ray.o0 + s * d_ray.d0 + change.s * ray.d0;
    take_slopes(n, s, from, to, [&](int c, const Slope& slope) {
        if (!IS_SLICED) change.v[c] += d_z * slope.z;
        change.v[c] += d_y * slope.y + d_x * slope.x;
        const int k = c - FIRST_MASS;
        if (k < 0 || k >= MASSES) return;
        if (!IS_SLICED) change.bend[k] += d_z * slope.bend_z;
        change.bend[k] += d_y * slope.bend_y + d_x * slope.bend_x;
    });
};
"""
"""The tangent: before the walk, which has `d_rays`."""
STAY_TANGENT = """
auto move_node = [&](int, const Node&, Node& change) { change.t = none; };
auto move_values = [](auto&&...) {};
"""
"""The same where rays stay."""
