"""The view-ray integral as fused kernels (NVIDIA Warp): nothing is kept between out and back.

`cells` says where nodes are, in slices or at equal steps, and which segments are walked; `bundle`
what kernels are given of rays, beams and phase functions; `kernels` what a node holds.
Rays go in packets, a ray a lane of a processor's vectors: `cells.h` has values at nodes and how
they change with the rays, `runs.h` those of lanes close to each other, and their adjoint,
`optics.h` the formulas, `rays.h` what a node emits, the integral and its tangent, and `back.h` the
adjoint.
`integrate` makes of all that one function of an `OutgoingLight`.
"""
