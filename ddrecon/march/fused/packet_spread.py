"""C++ of packets of rays: cotangents of values at nodes go back to the cells.

Neighboring rays meet the same cells. Of some lanes, a run, whose nodes lie between the same two
rows and within LANES columns, cells of these columns add up all shares in vectors, and are written
once:

                 lane l, with weights L of its columns i, j
        row m    .  .  .  .  .  .  .
        row i    .  .  #  #  .  .  .      # += (1 - a) bar L
        row j    .  .  #  #  .  .  .      # += a bar L
        row p    .  .  .  .  .  .  .
              first column
"""

SPREAD = """
#if defined(__CUDA_ARCH__)
auto spread_to_cells = [&](const Node& node, long long offset, const V* v_bar, const V* bend_bar) {
    const I ys[4] = {node.y.m, node.y.i, node.y.j, node.y.p};
    const I xs[4] = {node.x.m, node.x.i, node.x.j, node.x.p};
    const V ya = node.y.a, xa = node.x.a;
    // Linear weights, and those of a (1 - a) / 2 second differences.
    const V y_linear[4] = {0, 1 - ya, ya, 0}, x_linear[4] = {0, 1 - xa, xa, 0};
    const V y_bend[4] = {1 - ya, 3 * ya - 2, 1 - 3 * ya, ya};
    const V x_bend[4] = {1 - xa, 3 * xa - 2, 1 - 3 * xa, xa};
    for (int c = 0; c < CHANNELS; ++c) {
        if (!bars[c]) continue;
        F* field = (F*)bars[c] + offset;
        const int k = c - FIRST_MASS;
        const V bend = k >= 0 && k < MASSES ? bend_bar[k] : V(0);
        for (int j = 0; j < 4; ++j)
            for (int i = 0; i < 4; ++i) {
                const V weight = v_bar[c] * y_linear[j] * x_linear[i]
                    + bend * (node.y.excess * y_bend[j] * x_linear[i]
                              + node.x.excess * y_linear[j] * x_bend[i]);
                if (weight != V(0)) P::add(field, ys[j] * lines.row + xs[i] * lines.column, weight);
            }
    }
};
#else
// 1 in column k of a run: entries 15 - k to 30 - k.
F ones[2 * LANES - 1] = {};
ones[LANES - 1] = F(1);
auto one_at = [&](int k) -> V {
    V x;
    __builtin_memcpy(&x, ones + LANES - 1 - k, sizeof(V));
    return x;
};
// Adds columns `low` to `high` of `sum`, which begin at `first`, to a row of cells.
auto add_row = [&](F* row, int first, int low, int high, const V& sum) {
    if (lines.column == 1 && lines.columns >= LANES) {
        V x;
        __builtin_memcpy(&x, row + first, sizeof(V));
        x += sum;
        __builtin_memcpy(row + first, &x, sizeof(V));
    } else {
        const F* values = (const F*)&sum;
        for (int j = low; j <= high; ++j) row[(long long)j * lines.column] += values[j - first];
    }
};
auto spread_to_cells = [&](const Node& node, long long offset, const V* v_bar, const V* bend_bar) {
    const Place &y = node.y, &x = node.x;
    // What columns' weights L, and those of second differences, count for in rows m, i, j, p.
    V linear[CHANNELS][2], before[MASSES + 1], behind[MASSES + 1], bent[MASSES + 1][2];
    for (int c = 0; c < CHANNELS; ++c) {
        linear[c][1] = v_bar[c] * y.a;
        linear[c][0] = v_bar[c] - linear[c][1];
        const int k = c - FIRST_MASS;
        if (k >= 0 && k < MASSES) {
            bent[k][1] = bend_bar[k] * y.a;
            bent[k][0] = bend_bar[k] - bent[k][1];
            before[k] = y.excess * bent[k][0];
            behind[k] = y.excess * bent[k][1];
            linear[c][0] += behind[k] - F(2) * before[k];
            linear[c][1] += before[k] - F(2) * behind[k];
        }
    }
    const int *xm = (const int*)&x.m, *xi = (const int*)&x.i, *xj = (const int*)&x.j;
    const int *xp = (const int*)&x.p, *yi = (const int*)&y.i;
    const F *xa = (const F*)&x.a, *excess = (const F*)&x.excess;
    for (int r = 0; r < node.runs; ++r) {
        const int begin = node.run[r].begin, end = node.run[r].end, first = node.run[r].first;
        const int low = node.run[r].low, high = node.run[r].high;
        V sums[CHANNELS][2], sums_before[MASSES + 1], sums_behind[MASSES + 1];
        for (int c = 0; c < CHANNELS; ++c) sums[c][0] = sums[c][1] = P::all(F(0));
        for (int k = 0; k < MASSES; ++k) sums_before[k] = sums_behind[k] = P::all(F(0));
        for (int l = begin; l < end; ++l) {
            const V at_i = one_at(xi[l] - first), at_j = one_at(xj[l] - first);
            const F w1 = xa[l], w0 = F(1) - w1;
            const V L = w0 * at_i + w1 * at_j;
            V bend = L;
            if (MASSES)
                bend = (excess[l] * (w1 - F(2) * w0)) * at_i + (excess[l] * (w0 - F(2) * w1)) * at_j
                     + (excess[l] * w0) * one_at(xm[l] - first)
                     + (excess[l] * w1) * one_at(xp[l] - first);
            for (int c = 0; c < CHANNELS; ++c) {
                sums[c][0] += ((const F*)&linear[c][0])[l] * L;
                sums[c][1] += ((const F*)&linear[c][1])[l] * L;
                const int k = c - FIRST_MASS;
                if (k >= 0 && k < MASSES) {
                    sums[c][0] += ((const F*)&bent[k][0])[l] * bend;
                    sums[c][1] += ((const F*)&bent[k][1])[l] * bend;
                    sums_before[k] += ((const F*)&before[k])[l] * L;
                    sums_behind[k] += ((const F*)&behind[k])[l] * L;
                }
            }
        }
        const long long at_m = (long long)((const int*)&y.m)[begin] * lines.row;
        const long long at_i = (long long)yi[begin] * lines.row;
        const long long at_j = (long long)((const int*)&y.j)[begin] * lines.row;
        const long long at_p = (long long)((const int*)&y.p)[begin] * lines.row;
        for (int c = 0; c < CHANNELS; ++c) {
            if (!bars[c]) continue;
            F* field = (F*)bars[c] + offset;
            add_row(field + at_i, first, low, high, sums[c][0]);
            add_row(field + at_j, first, low, high, sums[c][1]);
            const int k = c - FIRST_MASS;
            if (k >= 0 && k < MASSES) {
                add_row(field + at_m, first, low, high, sums_before[k]);
                add_row(field + at_p, first, low, high, sums_behind[k]);
            }
        }
    }
};
#endif
"""
