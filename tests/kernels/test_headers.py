"""Functions of the shared headers, in double precision: closed forms, and slopes by differences."""

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


DUAL = "typedef Dual<double, 1> N; N n(x, 1.0);"
AGREES = [
    ("out = decayed(4.0 * x).psi;", "out = -8.0 * decayed(4.0 * x).eta;"),
    ("out = eta_series(x);", "out = eta_slope_series(x);"),
    ("out = bounded(x, 0.7);", "out = Bounded<double>(x, 0.7).by_x;"),
    ("out = bounded(0.7, x);", "out = Bounded<double>(0.7, x).by_bound;"),
    *(
        (f"double n = x; out = {each};", f"{DUAL} out = ({each}).by[0];")
        for each in (
            "n * n * n - 2.0 * n + 1.0",
            "(n + 1.0) / (n * n + 2.0)",
            "1.0 / (3.0 - n) - n / 4.0",
            "root(n * n + n)",
            "pick(value_of(n) > 0.2, n * n, n * 3.0)",
        )
    ),
    *(
        (
            f"Taps<double> taps(Position<double>(10.0 * x, 9).a); out = taps.{each};",
            f"typedef Dual<double, 1> N; Position<N> at(10.0 * x, 9); at.a.by[0] = 10.0;"
            f" out = (Taps<N>(at.a).{each}).by[0];",
        )
        for each in (*(f"linear[{t}]" for t in (1, 2)), *(f"bend[{t}]" for t in range(4)))
    ),
]
"""A function of x, and its slope as a header has it."""


def test_slopes_are_those_of_values() -> None:
    values, slopes = (list(texts) for texts in zip(*AGREES, strict=True))
    x, step = torch.tensor([0.013, 0.11, 0.237, 0.345, 0.462], dtype=torch.float64), 1e-5
    differences = (find(values, x + step) - find(values, x - step)) / (2 * step)
    torch.testing.assert_close(find(slopes, x), differences, rtol=1e-6, atol=1e-7)
