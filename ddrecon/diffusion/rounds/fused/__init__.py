"""A sweep as fused kernels (NVIDIA Warp): directions that cross the same slices go side by side.

`rows` is the C++ of a row of cells, `kernels` hands it rows, or single cells on a GPU; `schedule`
says which directions go together and in which thread, and `sweep` makes of it one function of
tensors.
"""
