"""How exactly a reconstruction's solves are needed: no more so than its gradient is.

The gradient is J^T e, e being how far the images are from their targets and J their derivative, so
that an error of the light of relative size t changes e by t times the image, or by t / misfit of
itself, misfit being |e| over the size of the targets. The adjoint solve is linear in e: its
relative error is the gradient's, whatever the misfit.
"""

from __future__ import annotations

GRADIENT_ERROR = 0.01
"""The relative error that each of the two solves may make in the gradient."""


def solve_tolerances(misfit: float) -> dict[str, float]:
    """The relative residual at which each kind of solve may stop, by kind.

    `misfit` >= 0 is that of the last images that were compared.
    """
    return {"forward": GRADIENT_ERROR * min(misfit, 1.0), "adjoint": GRADIENT_ERROR}
