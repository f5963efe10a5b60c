"""The log of a reconstruction: one row an iteration, and the sum of all rows so far."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Row:
    """One iteration. PSNRs [dB] are means over views; `test_psnr` is None where none was rendered.

    `loss` is the sum of `data_loss`, that of the images, and `penalty`, those of the parameters.
    `seconds` count from the start of the run; `cells` are those of the grid.
    """

    iteration: int
    seconds: float
    loss: float
    psnr: float
    test_psnr: float | None
    forward_iterations: int
    adjoint_iterations: int
    cells: int
    data_loss: float
    penalty: float


NO_ROWS = Row(0, 0.0, math.nan, math.nan, None, 0, 0, 0, math.nan, math.nan)
"""The sum of no rows."""


def sum_rows(total: Row, row: Row) -> Row:
    """`total` of the rows before `row`, and `row`.

    It is `row` with all solver iterations so far and the last known PSNR of test views.
    """
    return replace(
        row,
        test_psnr=total.test_psnr if row.test_psnr is None else row.test_psnr,
        forward_iterations=total.forward_iterations + row.forward_iterations,
        adjoint_iterations=total.adjoint_iterations + row.adjoint_iterations,
    )
