"""The diffusion problem's formulas for each cell and its faces, as fused kernels."""
