"""Light at cells, as fused kernels."""
