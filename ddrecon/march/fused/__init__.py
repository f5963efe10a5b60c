"""The view-ray integral as fused kernels (NVIDIA Warp): one thread a ray, nothing kept between.

`layout` says what a node holds, `sampling` how it is interpolated, `optics` the formulas, `nodes`
what a node emits, `kernels` the walk along a ray with both derivatives, and `integrate` the one
function on tensors that the rest of the program calls.
"""
