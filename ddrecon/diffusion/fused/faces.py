"""C++ that kernels of cells and their faces share: neighbors, and the factors of faces."""

FACES = """
const bool zl = z > 0, zh = z < nz - 1, yl = y > 0, yh = y < ny - 1;
// From a cell to its neighbors across each face; to itself where the box ends.
const long long to_zl = zl ? -plane : 0, to_zh = zh ? plane : 0;
const long long to_yl = yl ? -nx : 0, to_yh = yh ? nx : 0;
// With this t, 2 a t is the harmonic mean of D = a here and D = b beyond (E7); on the box it is
// what escapes there, 1 / (2 + h / (2 a)) (E6).
auto share = [](F a, F b, F h, bool inside) HERE -> F {
    return (inside ? b : F(1)) / (inside ? a + b : F(4) * a + h);
};
// (p + p beyond) / 2, or (h / 2) p on the box: what Q1 drives through a face, p = kappa_s Q1.
auto driven = [](F p, F beyond, F h, bool inside) HERE -> F {
    return F(0.5) * (inside ? p + beyond : h * p);
};
// All cells of the part, with whether and where there are neighbors along x. Beside the ends of a
// row lie other rows, which may be read for nothing, but for the first row and the last.
auto each = [&](auto&& cell) HERE {
    if (row > 0 && row < nz * ny - 1) {
#pragma clang loop vectorize(assume_safety)
        for (int i = begin; i < end; ++i) cell(i, i > 0, i < nx - 1, -1, 1);
    } else {
        for (int i = begin; i < end; ++i)
            cell(i, i > 0, i < nx - 1, i > 0 ? -1 : 0, i < nx - 1 ? 1 : 0);
    }
};
"""
