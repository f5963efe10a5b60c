"""The scalars of conjugate gradients, in double precision; they stay where the kernels run.

Each row has a partial sum of every share of every color, or a count. What one launch writes no
other share of it reads, so rows that are both come twice, for iterations of even and odd number.
"""

ROWS = (
    "CORRECTED",
    "CORRECTED_ODD",
    "CURVED",
    "RESIDUAL",
    "RESIDUAL_ODD",
    "SOURCE_NORM",
    "COUNT",
    "COUNT_ODD",
)
"""r M r of cycle M, d A d of direction d, squares of residual and right side, iterations made."""

TEXT = (
    f"enum {{{', '.join(name + '_ROW' for name in ROWS)}}};"
    + """
const auto total_of = [&](int row) -> double {
    double total = 0.0;
    for (int k = 0; k < shares; ++k) total += sums[(row * all_colors + color) * shares + k];
    return total;
};
const auto above = [](double a, double b) { return a > b ? a : b; };
const int now = iteration & 1, later = 1 - now;
// Whether this color is as exact as asked for; so is, for good, what is not a number.
const double relative = sqrt(total_of(RESIDUAL_ROW + now))
    / above(sqrt(total_of(SOURCE_NORM_ROW)), tiny);
const bool is_done = !(relative > tolerance);
"""
)
