"""Nodes, where rays are sampled, and integrals of what is linear between them."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Nodes:
    """N nodes on each of R rays.

    `origin` and unit `direction` [R, 3] of the rays, in array order; `distance` [N, R]: from the
    origin to the nodes [u].
    """

    origin: Tensor
    direction: Tensor
    distance: Tensor

    @property
    def lengths(self) -> Tensor:
        """The lengths [u] of the segments between nodes, `[N - 1, R]`."""
        return self.distance[1:] - self.distance[:-1]

    def integral(self, values: Tensor, measure: Tensor | None = None) -> Tensor:
        """The integral `[N - 1, K, R]` over each segment of what is linear between nodes.

        `values`: [N, K, R] at the nodes; `measure` [N - 1, R]: of each segment, by default its
        length.
        """
        over = self.lengths if measure is None else measure
        return 0.5 * (values[:-1] + values[1:]) * over[:, None]
