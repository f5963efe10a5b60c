"""Functions of the shared headers, in double precision: closed forms."""

import pytest
import torch
from torch import Tensor

pytest.importorskip("warp", reason="Warp is not installed (extra `warp`)")

from ddrecon.kernels.text import TextKernel

HEADER = "kernels/third_order.h"
DEPTHS = torch.cat([torch.logspace(-9, 2.5, 400), torch.linspace(0.49, 0.51, 41)]).double()


def find(texts: list[str], x: Tensor) -> Tensor:
    """`out` of each of the texts in C++, a row, at each `x`."""
    parts = (
        f"{{ double out; {text} made[{k} * count + item] = out; }}" for k, text in enumerate(texts)
    )
    text = "const double x = given_x[item];" + "".join(parts)
    made = x.new_empty(len(texts), len(x))
    kernel = TextKernel("find", 64, text, "F *given_x, *made; int count", "made", HEADER)
    kernel.launch(len(x), {"given_x": x, "count": len(x)}, {"made": made})
    return made


def phi(x: Tensor) -> Tensor:
    return -torch.expm1(-x) / x


def psi(x: Tensor) -> Tensor:
    """(1 - phi) / x, which loses digits in thin cells: there its series."""
    near = 1 / 2 - x / 6 + x**2 / 24 - x**3 / 120 + x**4 / 720
    return torch.where(x < 1e-3, near, (1 - phi(x)) / x)


def test_they_are_what_closed_forms_say() -> None:
    exact = {
        "out = decay(x);": torch.exp(-DEPTHS),
        "out = decayed(x).phi;": phi(DEPTHS),
        "out = decayed(x).psi;": psi(DEPTHS),
        "out = bounded(x, 3.0);": DEPTHS / (1 + 9 * DEPTHS**2).sqrt(),
    }
    found = find(list(exact), DEPTHS)
    torch.testing.assert_close(found, torch.stack(list(exact.values())), rtol=2e-12, atol=0)
