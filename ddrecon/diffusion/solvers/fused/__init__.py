"""Multigrid for the engine warp: the same cycle as PyTorch's, in a few launches of fused kernels."""
