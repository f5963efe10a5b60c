"""What is done to every number of a parameter in an iteration, in one pass, by fused kernels."""
