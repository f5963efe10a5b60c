"""C++ of the coarsening along one axis, row by row of the coarse grid (`solvers/coarsening.py`)."""

COARSENING = """
// Resistors from a pair's cell to the next pair's: where the face between stands, and 1 /
// resistance
const auto resist = [](const F* __restrict low, const F* __restrict face, const F* __restrict high,
                       F* __restrict below, F* __restrict above, F* __restrict along, int count,
                       int step, F after) APART {
    for (int i = 0; i < count; ++i) {
        const F half_low = F(0.5) / low[i * step], half_high = after / high[i * step];
        const F resistance = half_low + F(1) / face[i * step] + half_high;
        below[i] = half_low / resistance;
        above[i] = half_high / resistance;
        along[i] = F(1) / resistance;
    }
};
const auto weigh = [&](int s, int color, int first, int last) APART {
    const Grid g = grid_of(s, color), c = grid_of(s + 1, color);
    const int a = (int)at(s, AXIS);
    for (int r = first; r < last; ++r) {
        const int z = r / c.ny, y = r - z * c.ny;
        F* below = in_data(s, BELOW, color, c.cells) + (Size)r * c.nx;
        F* above = in_data(s, ABOVE, color, c.cells) + (Size)r * c.nx;
        F* along = &work[at(s + 1, CZ + a) + color * c.cells + (Size)r * c.nx];
        const int pair = a == 0 ? z : y, cells = a == 0 ? g.nz : g.ny;
        if (a < 2 && 2 * pair + 2 < cells) {
            const F* start = g.faces[a] + (a == 0 ? 2 * z : z) * g.zs[a] + (a == 1 ? 2 * y : y) *
                g.ys[a];
            const Size next = a == 0 ? g.zs[0] : g.ys[1];
            const bool has_high = 2 * pair + 3 < cells;
            resist(start, start + next, has_high ? start + 2 * next : start, below, above, along,
                c.nx,
                   1, has_high ? F(0.5) : F(0));
        } else if (a == 2) {
            const F* start = g.faces[2] + z * g.zs[2] + y * g.ys[2];
            // The last cell stands alone where their number is odd.
            const int faces = c.nx - 1, full = (g.nx & 1) ? faces - 1 : faces;
            resist(start, start + 1, start + 2, below, above, along, full, 2, F(0.5));
            if (full < faces)
                resist(start + 2 * full, start + 2 * full + 1, start + 2 * full, below + full,
                       above + full, along + full, 1, 2, F(0));
            below[faces] = above[faces] = along[faces] = F(0);
        } else {
            for (int i = 0; i < c.nx; ++i) below[i] = above[i] = along[i] = F(0);
        }
    }
};
// Half of c (w - w')^2, of cells below and above: what differing weights add along the axis
const auto stiffen = [](F* __restrict along, const F* __restrict low, const F* __restrict high,
                        const F* __restrict below, const F* __restrict below_next,
                        const F* __restrict above, const F* __restrict above_next, int count,
                        int step) APART {
    for (int i = 0; i < count; ++i) {
        const F b = below[i] - below_next[i], a = above[i] - above_next[i];
        along[i] += F(0.5) * (low[i * step] * b * b + high[i * step] * a * a);
    }
};
const auto coarsen_cells = [&](int s, int color, int first, int last) APART {
    const Grid g = grid_of(s, color), c = grid_of(s + 1, color);
    const int a = (int)at(s, AXIS), nx = c.nx;
    F* const second = own + widest;
    for (int r = first; r < last; ++r) {
        const int z = r / c.ny, y = r - z * c.ny;
        const int z1 = a == 0 ? 2 * z : z, y1 = a == 1 ? 2 * y : y;
        const int z2 = z1 + (a == 0), y2 = y1 + (a == 1);
        const bool has_two = z2 < g.nz && y2 < g.ny;
        // across the axis in parallel, and losses: sums of pairs
        for (int b = 0; b < 4; ++b) {
            if (b == a) continue;
            F* __restrict out = &work[at(s + 1, CZ + b) + color * c.cells + (Size)r * nx];
            const F* __restrict one = b < 3 ? row_of(g, b, z1, y1, own)
                                            : g.loss + ((Size)z1 * g.ny + y1) * g.nx;
            if (a < 2) {
                const F* __restrict two = !has_two ? zero
                    : b < 3 ? row_of(g, b, z2, y2, second) : g.loss + ((Size)z2 * g.ny + y2) * g.nx;
                for (int i = 0; i < nx; ++i) out[i] = one[i] + two[i];
            } else {
                const int pairs = g.nx / 2;
                for (int i = 0; i < pairs; ++i) out[i] = one[2 * i] + one[2 * i + 1];
                if (pairs < nx) out[pairs] = one[2 * pairs];
            }
        }
        // Galerkin: energy of what runs across the axis, of both neighbors along b
        F* along = &work[at(s + 1, CZ + a) + color * c.cells + (Size)r * nx];
        const F* below = in_data(s, BELOW, color, c.cells) + (Size)r * nx;
        const F* above = in_data(s, ABOVE, color, c.cells) + (Size)r * nx;
        const int count = a == 2 ? nx - 1 : nx;
        if ((a == 0 && z == c.nz - 1) || (a == 1 && y == c.ny - 1)) continue;
        // the cells below and above the face between pairs
        const int zl = a == 0 ? 2 * z + 1 : z, zh = a == 0 ? zl + 1 : z;
        const int yl = a == 1 ? 2 * y + 1 : y, yh = a == 1 ? yl + 1 : y;
        for (int b = 0; b < 2; ++b) {
            if (b == a) continue;
            const int place = b == 0 ? z : y, size = b == 0 ? c.nz : c.ny;
            const int next = b == 0 ? c.ny * nx : nx, step = a == 2 ? 2 : 1;
            for (int side = 0; side < 2; ++side) {
                if (side == 0 ? place == 0 : place == size - 1) continue;
                // the face towards the neighbor: that above the lower of both
                const int dz = b == 0 && side == 0, dy = b == 1 && side == 0;
                const F* low = row_of(g, b, zl - dz, yl - dy, own) + (a == 2 ? 1 : 0);
                const F* high = row_of(g, b, zh - dz, yh - dy, own) + (a == 2 ? 2 : 0);
                const int to = side == 0 ? -next : next;
                if (step == 1) stiffen(along, low, high, below, below + to, above, above + to,
                    count, 1);
                else stiffen(along, low, high, below, below + to, above, above + to, count, 2);
            }
        }
        if (a < 2) {
            const F* low = row_of(g, 2, zl, yl, own);
            const F* high = row_of(g, 2, zh, yh, second);
            stiffen(along, low, high, below, below + 1, above, above + 1, nx - 1, 1);
            stiffen(along + 1, low, high, below, below + 1, above, above + 1, nx - 1, 1);
        }
    }
};
"""
