"""Iterative solvers of A u = b, chosen by name from `SOLVERS`.

Each is a function `solve(operator, source, guess, tolerance) -> Solution`. All work on the system
scaled to a unit diagonal, S A S (S^-1 u) = S b with S = diagonal^(-1/2), and stop when the norm of
its residual falls below `tolerance` times that of its right side, for every color. To add one:
write it, enter it here.
"""

from ddrecon.diffusion.solvers import multigrid

SOLVERS = {
    "multigrid": multigrid.multigrid,
    "conjugate_gradient": multigrid.conjugate_gradient,
    "jacobi": multigrid.jacobi,
}
