"""A sweep as fused kernels (NVIDIA Warp): directions that cross the same slices go side by side.

`step.h` is the one formula of a step, in numbers or dual ones. `rows.h` follows light along rows
of cells, on a processor, and `returning.h` is the adjoint; `sweep_cells.h` does single cells, on a
GPU. What these are given stands in `given.h`. `schedule` says which directions go together, `jobs`
in which thread, and `sweep` makes of it one function of tensors.
"""
