"""The log of a reconstruction, one row an iteration, their sum, and the result."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ddrecon.display import Displayed
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
class Result(Displayed):
    """A finished reconstruction: the `scene` with its reconstructed volume, and the log."""

    scene: Scene
    rows: list[Row]

    def _repr_html_(self) -> str:
        """The reconstructed scene, in a notebook, and how well it fits."""
        last = self.rows[-1]
        test = [row.test_psnr for row in self.rows if row.test_psnr is not None][-1:]
        tested = f", {test[0]:.2f} dB of views held out" if test else ""
        fit = f"{last.iteration} iterations, PSNR {last.psnr:.2f} dB of views trained on{tested}"
        return f"<p>{fit}</p>{self.scene._repr_html_()}"
