"""The view-ray integral as fused kernels (NVIDIA Warp): one thread a ray, nothing kept between.

`layout` says what a node holds and `rays` what a ray is; `lines`, `planes` and `sampling` find the
values at a node, `nodes` what it emits (by the formulas of `optics`), and `segments` what arrives
from between two. `walks` and `adjoint` are the kernels. `integrate` makes of them one function of
tensors, and `march` calls that for an `Emission`.
"""
