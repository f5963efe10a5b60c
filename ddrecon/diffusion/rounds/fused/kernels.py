"""The kernels of a sweep whose items are jobs: many directions through all rows of a color."""

import functools

from ddrecon.diffusion.rounds.fused.returning_rows import RETURN
from ddrecon.diffusion.rounds.fused.rows import FOLLOW, GIVEN
from ddrecon.diffusion.rounds.fused.share import constants
from ddrecon.kernels.native import TOTAL
from ddrecon.kernels.text import TextKernel


@functools.cache
def follow_kernel(bits: int, shares_field: bool, keeps: bool) -> TextKernel:
    """The kernel that follows radiance; it finds moments, or `keeps` lines of all slices.

    `shares_field`: whether extinction and scattering have the same field.
    """
    text = constants(SHARES_FIELD=shares_field, KEEPS=keeps) + FOLLOW
    return TextKernel("follow_rows", bits, text, GIVEN)


@functools.cache
def return_kernel(bits: int, shares_field: bool, varies_numbers: bool) -> TextKernel:
    """The kernel that follows it back; `varies_numbers`: derivatives by scales are asked for."""
    text = constants(SHARES_FIELD=shares_field, VARIES_NUMBERS=varies_numbers) + TOTAL + RETURN
    return TextKernel("return_rows", bits, text, GIVEN)
