"""The solver of A u = b: conjugate gradients, preconditioned by a V-cycle of multigrid.

It works on the system scaled to a unit diagonal, S A S (S^-1 u) = S b with S = diagonal^(-1/2), and
stops when the norm of its residual falls below `tolerance` times that of its right side, for every
color.
"""
