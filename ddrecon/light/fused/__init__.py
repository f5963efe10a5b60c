"""Light at cells by fused kernels in NVIDIA Warp.

`light.shear`, `light.moments` and `Coefficient` are their definition.
"""
