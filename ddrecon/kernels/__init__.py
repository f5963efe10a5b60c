"""How fused kernels are written, compiled and launched, for all parts of the renderer."""
