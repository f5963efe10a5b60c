"""The log of a reconstruction, one row an iteration, their sum, and the result."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ddrecon.scene import Scene


@dataclass(frozen=True)
class Row:
    """One iteration. PSNRs [dB] and SSIMs are means over views, of values as they are compared.

    `loss` is the sum of `data_loss`, that of the images, and `penalty`, those of the parameters.
    `seconds` count from the start of the run; `cells` are those of the grid. The numbers of test
    views are None where none was rendered, and SSIMs where they were not looked at.
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
    ssim: float | None = None
    test_ssim: float | None = None


NO_ROWS = Row(0, 0.0, math.nan, math.nan, None, 0, 0, 0, math.nan, math.nan)
"""The sum of no rows."""


@dataclass(frozen=True, repr=False)
class Result:
    """A finished reconstruction: the `scene` with its reconstructed volume, and the log."""

    scene: Scene
    rows: list[Row]
