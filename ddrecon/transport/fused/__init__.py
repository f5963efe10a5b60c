"""A sweep as fused kernels (NVIDIA Warp), one text for processors and GPUs.

`ordinates.h` follows light along ordinates of a quadrature set, forward and back, and has the
formula of a step in numbers or dual ones. `ordinates.py` has the tables that it is given,
`sweep.py` launches it as one differentiable function of tensors.
"""
