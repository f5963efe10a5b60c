"""Multiply scattered light by the diffusion approximation: the operator, its solvers and the
derivatives of a solve.
"""
