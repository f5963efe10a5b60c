"""C++ of a level: where its numbers are, its stencil, and inner products."""

APART = """
#define APART __attribute__((noinline))  // compiled once, however often it is called
"""
VECTORS = "enum { Y, R, D, D_ODD, P, Q, VECTORS };"
"""Solution, residual, directions of even and odd iterations, what the cycle makes, A d."""

GIVEN = """
long *table; F *data, *vectors, *scratch; double *sums;
long first_vector, vector_size, scratch_size; double tolerance, tiny;
int iteration, matrices, all_colors, shares;
"""
"""What both kernels of a solve are given."""

# What neighbors send to cell i: conductance times value, faces lying at the cell below them.
LEVEL = (
    APART
    + VECTORS
    + """
const auto vector_at = [&](int k) { return vectors + first_vector + k * vector_size; };
typedef long long Size;
const auto at = [&](int stage, int column) -> Size {
    return table[(Size)stage * COLUMNS + column];
};
struct Level { int nz, ny, nx; Size slice, cells; const F *cz, *cy, *cx, *scale, *taken; };
const auto level_of = [&](int s, int matrix) {
    Level l;
    l.nz = (int)at(s, NZ); l.ny = (int)at(s, NY); l.nx = (int)at(s, NX);
    l.slice = (Size)l.ny * l.nx;
    l.cells = l.nz * l.slice;
    l.cz = &data[at(s, SZ) + matrix * l.cells];
    l.cy = &data[at(s, SY) + matrix * l.cells];
    l.cx = &data[at(s, SX) + matrix * l.cells];
    l.scale = &data[at(s, SCALE) + matrix * l.cells];
    l.taken = &data[at(s, TAKEN) + matrix * l.cells];
    return l;
};
#define NEIGHBORS(u) (cx[i] * u[i + 1] + cx[i - 1] * u[i - 1] + cy[i] * u[i + nx] \\
    + cy[i - nx] * u[i - nx] + cz[i] * upper[i] + lz[i] * lower[i])
// a here + b base + times (what neighbors send), of slice z. The lower face of the first slice is
// taken from the last slice, where faces lie on the box and are zero.
const auto stencil = [](const Level& l, int z, const F* __restrict lower, const F* __restrict here,
                        const F* __restrict upper, const F* __restrict base, F a, F b, F times,
                        F* __restrict out) APART {
    const Size nx = l.nx, slice = l.slice;
    const F *__restrict cz = l.cz + z * slice, *__restrict cy = l.cy + z * slice;
    const F *__restrict cx = l.cx + z * slice;
    const F* __restrict lz = l.cz + (z > 0 ? z - 1 : l.nz - 1) * slice;
    for (Size i = 0; i < slice; ++i) out[i] = a * here[i] + b * base[i] + times * NEIGHBORS(here);
};
const auto inner = [](const F* __restrict a, const F* __restrict b, Size count) APART -> double {
    double part[16] = {}, total = 0.0;
    Size i = 0;
    for (; i + 16 <= count; i += 16)
        for (int k = 0; k < 16; ++k) part[k] += (double)a[i + k] * (double)b[i + k];
    for (; i < count; ++i) total += (double)a[i] * (double)b[i];
    for (int k = 0; k < 16; ++k) total += part[k];
    return total;
};
"""
)
