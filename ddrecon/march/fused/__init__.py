"""The view-ray integral as fused kernels (NVIDIA Warp): nothing is kept between out and back.

`layout` says what a node holds, and `cells` where nodes are: in slices, or at equal steps.
Rays go in packets, a ray a lane of a processor's vectors: `packet_cells` has values at nodes,
`packet_runs` those of lanes close to each other, `packet_spread` their adjoint and `packet_slopes`
how they change with the rays, `packet_optics` the formulas, `packet_rays` what a node emits, and
`packet_walks` and `packet_tangent` the kernels. `stretches` finds which segments of a packet are
walked at all. `between` and `pixels` interpolate pixels between rays of a lattice.
Phase functions that differ from cell to cell are tables and a number of the cell: `cellwise` says
which, `packet_cellwise` reads them.
`integrate` makes of all that one function of tensors, and `march` calls it for an `Emission`.
"""
