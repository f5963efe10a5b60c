"""The view-ray integral as fused kernels (NVIDIA Warp): nothing is kept between out and back.

`layout` says what a node holds and `rays` what a ray is, `cells` where its nodes are.
Rays that meet slices go in packets, a ray a lane of a processor's vectors: `packet_cells` has
values at nodes, `packet_runs` those of lanes close to each other, `packet_spread` their adjoint and
`packet_slopes` how they change with the rays, `packet_optics` the formulas, `packet_rays` what a
node emits, and `packet_walks` and `packet_tangent` the kernels. `stretches` finds which segments of
a packet are walked at all. `between` and `pixels` interpolate pixels between rays of a lattice.
A ray a thread, in Warp's own language, are equal steps, and derivatives by rays beside light from
points: `lines`, `planes` and `sampling` find values among cells, `stops` those at a node,
`emission` what it emits (by `node_phases` and the formulas of `optics`), and `segments` what
arrives from between two; `walks` and `adjoint` are the kernels.
Phase functions that differ from cell to cell are tables and a number of the cell: `cellwise` says
which, `packet_cellwise` and `node_curves` read them.
`integrate` makes of all that one function of tensors, and `march` calls it for an `Emission`.
"""
