"""C++ of packets of places: cotangents of values there go back to the cells.

Neighboring rays meet the same cells. Of some lanes, a run, whose nodes lie between the same two
rows and within LANES columns, cells of these columns add up all shares in vectors, and are written
once:

                 lane l, with weights L of its columns i, j
        row m    .  .  .  .  .  .  .
        row i    .  .  #  #  .  .  .      # += (1 - a) bar L
        row j    .  .  #  #  .  .  .      # += a bar L
        row p    .  .  .  .  .  .  .
              first column

Where lanes lie in the order of their columns, and a few to each, columns pick them instead: the
first of those that lie right of each column, the second, and so on.
"""

_ON_A_GPU = """
struct Shares {
    Place y, x;
    Lines lines;
    static INLINE Shares of(const Place& y, const Place& x, const Lines& lines) {
        return Shares{y, x, lines};
    }
    void add(F* field, V bar, V bend_bar) const {
        const I ys[4] = {y.m, y.i, y.j, y.p}, xs[4] = {x.m, x.i, x.j, x.p};
        const V ya = y.a, xa = x.a;
        // Linear weights, and those of a (1 - a) / 2 second differences.
        const V y_linear[4] = {0, 1 - ya, ya, 0}, x_linear[4] = {0, 1 - xa, xa, 0};
        const V y_bend[4] = {1 - ya, 3 * ya - 2, 1 - 3 * ya, ya};
        const V x_bend[4] = {1 - xa, 3 * xa - 2, 1 - 3 * xa, xa};
        for (int j = 0; j < 4; ++j)
            for (int i = 0; i < 4; ++i) {
                const V weight = bar * y_linear[j] * x_linear[i]
                    + bend_bar * (y.excess * y_bend[j] * x_linear[i]
                                  + x.excess * y_linear[j] * x_bend[i]);
                if (weight != V(0)) P::add(field, ys[j] * lines.row + xs[i] * lines.column, weight);
            }
    }
};
"""
_IN_COLUMNS = """
// 1 in column k of a run: entries LANES - 1 - k on.
struct Ones {
    F values[2 * LANES - 1];
    V at(int k) const {
        V x;
        __builtin_memcpy(&x, values + LANES - 1 - k, sizeof(V));
        return x;
    }
};
Ones ones = {};
ones.values[LANES - 1] = F(1);
constexpr int MOST_ALIKE = 8;
// What the lanes of a run count for columns `first` to `first` + LANES - 1 of cells.
struct Shares {
    Run run;
    Lines lines;
    int first, alike;
    long long at_m, at_i, at_j, at_p;
    V ya, y_excess, xa, x_excess, at_low, at_high;
    // If up to so many lanes lie `alike` right of the same column: for each column the lanes whose
    // m, i, j or p it is. Else each lane's weights of columns, and those of a (1 - a) / 2 second
    // differences.
    I m[MOST_ALIKE], i[MOST_ALIKE], j[MOST_ALIKE], p[MOST_ALIKE];
    V linear[LANES], bent[LANES];

    void pick_lanes(const Place& x) {
        const I numbers = P::numbers(), none = I{} + LANES;
        const int count = __builtin_popcount(run.lanes), begin = P::lane_of(x.i, run.lane);
        // The run's lanes first, the columns right of which they lie, and those after new ones.
        const I lanes = Rows::gather_lanes(numbers, run.lanes, none);
        const I column = Rows::pick_any(x.i, lanes, none), is_lane = numbers < count;
        const I before = Rows::pick_any(column, (numbers - 1) & (LANES - 1), none);
        const I step = P::pick(is_lane & (numbers > 0), column - before, I{});
        if (!__builtin_reduce_and((step == 0) | (step == 1))) return;
        const unsigned starts = P::bits_of((step == 1) | (numbers == 0));
        const I start = Rows::gather_lanes(numbers, starts, I{} + count);
        const I next = Rows::pick_any(start, numbers + 1, I{} + count);
        const int most = __builtin_reduce_max(next - start);
        if (most > MOST_ALIKE) return;
        // The first column is that left of the first lane's, or where LANES end with the row.
        const int last = lines.columns - LANES;
        first = begin - 1 < last ? (begin > 0 ? begin - 1 : 0) : last;
        const int shift = begin - 1 - first, end = begin + __builtin_popcount(starts) + 1;
        run.low = begin > 0 ? begin - 1 : 0;
        run.high = end < lines.columns ? end : lines.columns - 1;
        for (int k = 0; k < most; ++k) {
            const I which = P::pick(start + k < next, start + k, none);
            const I lane = Rows::pick_any(lanes, which, none);
            const I at = numbers - shift;
            m[k] = Rows::pick_any(lane, at & (2 * LANES - 1), none);
            i[k] = Rows::pick_any(lane, (at - 1) & (2 * LANES - 1), none);
            j[k] = Rows::pick_any(lane, (at - 2) & (2 * LANES - 1), none);
            p[k] = Rows::pick_any(lane, (at - 3) & (2 * LANES - 1), none);
        }
        // Beyond the ends of the row the columns at its ends count once more.
        at_low = __builtin_convertvector(-(x.m == x.i), V);
        at_high = __builtin_convertvector(-(x.p == x.j), V);
        alike = most;
    }
    static INLINE Shares of(const Run& run, const Place& y, const Place& x, const Lines& lines,
                     const Ones& ones, bool is_bent) {
        Shares s;
        s.run = run;
        s.lines = lines;
        s.first = run.first;
        s.alike = 0;
        s.at_m = (long long)P::lane_of(y.m, run.lane) * lines.row;
        s.at_i = (long long)P::lane_of(y.i, run.lane) * lines.row;
        s.at_j = (long long)P::lane_of(y.j, run.lane) * lines.row;
        s.at_p = (long long)P::lane_of(y.p, run.lane) * lines.row;
        s.ya = y.a; s.y_excess = y.excess; s.xa = x.a; s.x_excess = x.excess;
        if (HAS_PERMUTATION && lines.columns >= LANES) s.pick_lanes(x);
        if (s.alike) return s;
        const int *xm = (const int*)&x.m, *xi = (const int*)&x.i, *xj = (const int*)&x.j;
        const int *xp = (const int*)&x.p;
        const F *xa = (const F*)&x.a, *excess = (const F*)&x.excess;
        for (unsigned rest = run.lanes; rest; rest &= rest - 1) {
            const int l = __builtin_ctz(rest);
            const V at_i = ones.at(xi[l] - s.first), at_j = ones.at(xj[l] - s.first);
            const F w1 = xa[l], w0 = F(1) - w1;
            s.linear[l] = w0 * at_i + w1 * at_j;
            if (is_bent)
                s.bent[l] = (excess[l] * (w1 - F(2) * w0)) * at_i
                          + (excess[l] * (w0 - F(2) * w1)) * at_j
                          + (excess[l] * w0) * ones.at(xm[l] - s.first)
                          + (excess[l] * w1) * ones.at(xp[l] - s.first);
        }
        return s;
    }
    // To a row of cells what linear values there have as bars, and corrections along the row.
    void add_row(F* row, V bar) const {
        V sum = P::all(F(0));
        if (alike) {
            const V by_j = bar * xa, by_i = bar - by_j;
            for (int k = 0; k < alike; ++k)
                sum += Rows::pick_any(by_i, i[k]) + Rows::pick_any(by_j, j[k]);
        } else {
            for (unsigned rest = run.lanes; rest; rest &= rest - 1) {
                const int l = __builtin_ctz(rest);
                sum += ((const F*)&bar)[l] * linear[l];
            }
        }
        write(row, sum);
    }
    void add_bent_row(F* row, V bar, V bend_bar) const {
        V sum = P::all(F(0));
        if (alike) {
            const V bend = x_excess * bend_bar, by_p = bend * xa, by_m = bend - by_p;
            const V by_j = bar * xa + (by_m - F(2) * by_p) + at_high * by_p;
            const V by_i = bar * (F(1) - xa) + (by_p - F(2) * by_m) + at_low * by_m;
            for (int k = 0; k < alike; ++k)
                sum += (Rows::pick_any(by_m, m[k]) + Rows::pick_any(by_i, i[k]))
                     + (Rows::pick_any(by_j, j[k]) + Rows::pick_any(by_p, p[k]));
        } else {
            for (unsigned rest = run.lanes; rest; rest &= rest - 1) {
                const int l = __builtin_ctz(rest);
                sum += ((const F*)&bar)[l] * linear[l] + ((const F*)&bend_bar)[l] * bent[l];
            }
        }
        write(row, sum);
    }
    void write(F* row, const V& sum) const {
        if (lines.column == 1 && lines.columns >= LANES) {
            P::write(row + first, P::read(row + first) + sum);
        } else {
            const F* values = (const F*)&sum;
            for (int j = run.low; j <= run.high; ++j)
                row[(long long)j * lines.column] += values[j - first];
        }
    }
    void add(F* field, V bar) const {
        const V in_j = bar * ya;
        add_row(field + at_i, bar - in_j);
        add_row(field + at_j, in_j);
    }
    void add_bent(F* field, V bar, V bend_bar) const {
        const V bend_j = bend_bar * ya, bend_i = bend_bar - bend_j;
        const V in_m = y_excess * bend_i, in_p = y_excess * bend_j, in_j = bar * ya;
        add_row(field + at_m, in_m);
        add_row(field + at_p, in_p);
        add_bent_row(field + at_i, (bar - in_j) + (in_p - F(2) * in_m), bend_i);
        add_bent_row(field + at_j, in_j + (in_m - F(2) * in_p), bend_j);
    }
};
"""
SHARES = f"""
#if defined(__CUDA_ARCH__)
{_ON_A_GPU}
#else
{_IN_COLUMNS}
#endif
"""
"""Of places in a slice, what they count for the cells around; behind `packet_runs`."""

SPREAD = (
    SHARES
    + """
auto spread_to_cells = [&](const Spot& spot, long long offset, const V* v_bar, const V* bend_bar) {
#if defined(__CUDA_ARCH__)
    const Shares shares = Shares::of(spot.y, spot.x, lines);
    for (int c = 0; c < CHANNELS; ++c) {
        const int k = c - FIRST_MASS;
        if (bars[c])
            shares.add(bars[c] + offset, v_bar[c], k >= 0 && k < MASSES ? bend_bar[k] : V(0));
    }
#else
    bool is_wanted[CHANNELS], is_bent = false;
    M is_zero = P::all(F(0)) == P::all(F(0));
    for (int c = 0; c < CHANNELS; ++c) {
        const M is = v_bar[c] == P::all(F(0));
        is_wanted[c] = bars[c] && !P::every(is);
        if (is_wanted[c]) is_zero = is_zero & is;
        is_bent = is_bent || (is_wanted[c] && c >= FIRST_MASS && c < FIRST_MASS + MASSES);
    }
    // Lanes outside of the box count for nothing.
    const unsigned counting = ~P::bits_of(__builtin_convertvector(is_zero, I));
    for (int r = 0; r < spot.runs; ++r) {
        Run run = spot.run[r];
        run.lanes &= counting;
        if (!run.lanes) continue;
        run.lane = __builtin_ctz(run.lanes);
        const Shares shares = Shares::of(run, spot.y, spot.x, lines, ones, is_bent);
        #pragma clang loop unroll(disable)
        for (int c = 0; c < CHANNELS; ++c) {
            const int k = c - FIRST_MASS;
            if (!is_wanted[c]) continue;
            if (k >= 0 && k < MASSES) shares.add_bent(bars[c] + offset, v_bar[c], bend_bar[k]);
            else shares.add(bars[c] + offset, v_bar[c]);
        }
    }
#endif
};
auto spread_between = [&](const Node& node, const V* v_bar, const V* bend_bar) {
    const Layers layers = Layers::of(node.z);
    for (int i = 0; i < 4; ++i) {
        if (Layers::is_outer(i) && !MASSES) continue;
        V value_bar[CHANNELS], bent_bar[MASSES + 1];
        for (int c = 0; c < CHANNELS; ++c) value_bar[c] = layers.linear[i] * v_bar[c];
        for (int k = 0; k < MASSES; ++k) {
            value_bar[FIRST_MASS + k] += layers.across[i] * bend_bar[k];
            bent_bar[k] = layers.linear[i] * bend_bar[k];
        }
        Spot spot = node;
        spot.y = Place::behind(node.y, layers.at[i] * lines.rows);
        find_cells(spot);
        spread_to_cells(spot, 0, value_bar, bent_bar);
    }
};
"""
)
