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
        F* field = bars[c] + offset;
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
    const int *xm = (const int*)&x.m, *xi = (const int*)&x.i, *xj = (const int*)&x.j;
    const int *xp = (const int*)&x.p;
    const F *xa = (const F*)&x.a, *excess = (const F*)&x.excess;
    bool is_wanted[CHANNELS], is_bent = false;
    for (int c = 0; c < CHANNELS; ++c) {
        is_wanted[c] = bars[c] && !P::every(v_bar[c] == P::all(F(0)));
        is_bent = is_bent || (is_wanted[c] && c >= FIRST_MASS && c < FIRST_MASS + MASSES);
    }
    for (int r = 0; r < node.runs; ++r) {
        const int begin = node.run[r].begin, end = node.run[r].end, first = node.run[r].first;
        const int low = node.run[r].low, high = node.run[r].high;
        // Each lane's weights of columns: L, and those of a (1 - a) / 2 second differences.
        V L[LANES], bent[LANES];
        for (int l = begin; l < end; ++l) {
            const V at_i = one_at(xi[l] - first), at_j = one_at(xj[l] - first);
            const F w1 = xa[l], w0 = F(1) - w1;
            L[l] = w0 * at_i + w1 * at_j;
            if (is_bent)
                bent[l] = (excess[l] * (w1 - F(2) * w0)) * at_i
                        + (excess[l] * (w0 - F(2) * w1)) * at_j
                        + (excess[l] * w0) * one_at(xm[l] - first)
                        + (excess[l] * w1) * one_at(xp[l] - first);
        }
        const long long at_m = (long long)y.m[begin] * lines.row;
        const long long at_i = (long long)y.i[begin] * lines.row;
        const long long at_j = (long long)y.j[begin] * lines.row;
        const long long at_p = (long long)y.p[begin] * lines.row;
        #pragma clang loop unroll(disable)
        for (int c = 0; c < CHANNELS; ++c) {
            const int k = c - FIRST_MASS;
            if (!is_wanted[c]) continue;
            F* field = bars[c] + offset;
            V in_j = v_bar[c] * y.a, in_i = v_bar[c] - in_j, sum_i = P::all(F(0)), sum_j = sum_i;
            if (k >= 0 && k < MASSES) {
                const V bend_j = bend_bar[k] * y.a, bend_i = bend_bar[k] - bend_j;
                const V in_m = y.excess * bend_i, in_p = y.excess * bend_j;
                in_i += in_p - F(2) * in_m;
                in_j += in_m - F(2) * in_p;
                V sum_m = P::all(F(0)), sum_p = sum_m;
                for (int l = begin; l < end; ++l) {
                    sum_m += ((const F*)&in_m)[l] * L[l];
                    sum_p += ((const F*)&in_p)[l] * L[l];
                    sum_i += ((const F*)&in_i)[l] * L[l] + ((const F*)&bend_i)[l] * bent[l];
                    sum_j += ((const F*)&in_j)[l] * L[l] + ((const F*)&bend_j)[l] * bent[l];
                }
                add_row(field + at_m, first, low, high, sum_m);
                add_row(field + at_p, first, low, high, sum_p);
            } else {
                for (int l = begin; l < end; ++l) {
                    sum_i += ((const F*)&in_i)[l] * L[l];
                    sum_j += ((const F*)&in_j)[l] * L[l];
                }
            }
            add_row(field + at_i, first, low, high, sum_i);
            add_row(field + at_j, first, low, high, sum_j);
        }
    }
};
#endif
"""
