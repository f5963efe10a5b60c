"""theta of E14 at a cell, in C++: the share of a sweep's change that counts; and its slope."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.medium.coefficients import Medium

# d is the depth of a mean step, at least LEAST: theta is 1 there, but its formula 0 / 0 in empty
# cells. rho = d (psi / phi - 1/2).
SHARE = """
        const F LEAST = F(2e-3), e = e_row[i], thickness = numbers[c] * e;
        const bool is_empty = thickness < LEAST;
        const F depth = is_empty ? LEAST : thickness;
        const bool is_thin = depth < F(0.5);
        const F series = psi_series(is_thin ? depth : F(0));
        const F inverse = F(1) / (is_thin ? F(0.5) : depth);
        const F phi = is_thin ? F(1) - depth * series : (F(1) - decay(depth)) * inverse;
        const F psi = is_thin ? series : (F(1) - phi) * inverse;
        const F inverse_phi = F(1) / phi, rho = depth * (psi * inverse_phi - F(0.5));
        const F share = F(1) / (F(1) + rho * rho);
"""
# rho' = (phi - psi) / phi^2 - 1/2; none where cells are empty
SHARE_SLOPE = """
        const F rho_slope = (phi - psi) * inverse_phi * inverse_phi - F(0.5);
        const F share_slope = is_empty ? F(0) : F(-2) * share * share * rho * rho_slope;
"""


def constants(**is_so: bool) -> str:
    """C++ that declares constants of these names."""
    return "".join(f"const bool {name} = {str(so).lower()};\n" for name, so in is_so.items())


def numbers_by_color(medium: Medium, length: Tensor, others: Sequence[Tensor]) -> Tensor:
    """The depth of a step of `length` per unit of extinction's field, then `others`, [N, C]."""
    colors = max(each.numel() for each in (medium.extinction.scale, *others))
    each = medium.extinction.scale * length, *others
    return torch.stack([one.reshape(-1).expand(colors) for one in each])
