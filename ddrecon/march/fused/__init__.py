"""The view-ray integral as fused kernels (NVIDIA Warp): nothing is kept between out and back.

`layout` says what a node holds, and `cells` where nodes are: in slices, or at equal steps.
Rays go in packets, a ray a lane of a processor's vectors: `cells.h` has values at nodes and how
they change with the rays, `runs.h` those of lanes close to each other, `spread.h` their adjoint,
`optics.h` the formulas, `rays.h` what a node emits, `walk.h` the integral and its tangent, and
`back.h` the adjoint; `kernels` are made of these.
`stretches` finds which segments of a packet are walked at all; `between` interpolates pixels
between rays of a lattice.
Phase functions that differ from cell to cell are tables and a number of the cell: `cellwise` says
which.
`integrate` makes of all that one function of tensors, and `march` calls it for an `Emission`.
"""
