"""Light scattered many times, by diffusion: the operator, its solvers, derivatives of a solve."""
