"""Functions of the medium by fused kernels."""
