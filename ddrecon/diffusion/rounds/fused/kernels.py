"""The kernels of a sweep whose items are lanes: directions through all rows."""

import functools

from ddrecon.diffusion.rounds.fused.returning_rows import RETURN
from ddrecon.diffusion.rounds.fused.rows import FOLLOW, GIVEN, SCRATCH
from ddrecon.diffusion.rounds.fused.share import constants
from ddrecon.kernels.text import TextKernel


@functools.cache
def follow_kernel(bits: int, shares_field: bool) -> TextKernel:
    """The kernel that follows radiance and finds its moments.

    `shares_field`: whether extinction and scattering have the same field.
    """
    text = constants(SHARES_FIELD=shares_field, KEEPS=False) + FOLLOW
    return TextKernel("follow_rows", bits, text, GIVEN, "found saved leaving " + SCRATCH)


@functools.cache
def return_kernel(bits: int, shares_field: bool, varies_numbers: bool) -> TextKernel:
    """The kernel that follows it back; `varies_numbers`: derivatives by scales are asked for."""
    text = constants(SHARES_FIELD=shares_field, VARIES_NUMBERS=varies_numbers) + RETURN
    made = "found sums e_bar sc_bar returning entering_bar "
    return TextKernel("return_rows", bits, text, GIVEN, made + SCRATCH)
