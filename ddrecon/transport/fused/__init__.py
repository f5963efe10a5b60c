"""A sweep as fused kernels (NVIDIA Warp): directions that cross the same slices go side by side.

For processors alone: on a GPU torch's operations sweep. `step.h` is the one formula of a step, in
numbers or dual ones. `rows.h` follows light along rows of cells, and `returning.h` is the adjoint.
What these are given stands in `given.h`. `directions` says which directions go together, `rows`
launches the kernels, and `sweep` makes of it one function of tensors.
"""
