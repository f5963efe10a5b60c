"""The scalars of conjugate gradients, in double precision; they stay where the kernels run.

Each row has a partial sum of every share of every color; behind the rows two counts of iterations.
What one launch writes no other share of it reads, so rows that are both come twice, for iterations
of even and of odd number.
"""

ROWS = ("CORRECTED", "CORRECTED_ODD", "CURVED", "RESIDUAL", "RESIDUAL_ODD", "SOURCE_NORM", "COUNT")
"""r M r of cycle M, d A d of direction d, squares of residual and right side, the counts."""

TEXT = (
    f"enum {{{', '.join(name + '_ROW' for name in ROWS)}}};"
    + """
const auto total_of = [&](int row, int c) -> double {
    double total = 0.0;
    for (int k = 0; k < shares; ++k) total += sums.data[(row * all_colors + c) * shares + k];
    return total;
};
const auto above = [](double a, double b) { return a > b ? a : b; };
const int now = iteration & 1, later = 1 - now;
// Whether every color is as exact as asked for; so is, for good, what is not a number.
bool is_done = true;
for (int c = 0; c < all_colors; ++c) {
    const double relative = sqrt(total_of(RESIDUAL_ROW + now, c))
        / above(sqrt(total_of(SOURCE_NORM_ROW, c)), tiny);
    if (relative > tolerance) is_done = false;
    if (relative != relative) { is_done = true; break; }
}
"""
)
