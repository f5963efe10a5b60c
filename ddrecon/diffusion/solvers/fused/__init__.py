"""Multigrid for the engine warp: the cycle of PyTorch in a few launches of fused kernels."""
