"""Light not yet scattered by fused kernels in NVIDIA Warp; `light.shear` and `Coefficient` are its
definition.
"""
