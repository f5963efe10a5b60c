"""The view-ray integral as fused kernels (NVIDIA Warp): nothing is kept between out and back.

`cells` says where nodes are, in slices or at equal steps, and which segments are walked; `kernels`
says which fields a node holds.
Rays go in packets, a ray a lane of a processor's vectors: `cells.h` has values at nodes, `runs.h`
those of lanes close to each other, and their adjoint, `optics.h` the formulas, `rays.h` what a node
emits, the integral and its tangent, and `back.h` the adjoint.
`integrate` makes one function of an `OutgoingLight` of all that.
"""
