"""Where view rays are sampled, and how what is linear between samples is integrated."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Nodes:
    """N nodes on each of R rays: rays' `origin` and unit `direction` [R, 3] (array order), nodes'
    `distance` [N, R] from the origin [u].
    """

    origin: Tensor
    direction: Tensor
    distance: Tensor

    @property
    def lengths(self) -> Tensor:
        """The lengths [u] of the segments between nodes, `[N - 1, R]`."""
        return self.distance[1:] - self.distance[:-1]

    def integral(self, values: Tensor, measure: Tensor | None = None) -> Tensor:
        """The integral over each segment of what is linear between `values` [N, channels, R], by
        length or another `measure` [N - 1, R].
        """
        return (
            0.5
            * (values[:-1] + values[1:])
            * (self.lengths if measure is None else measure)[:, None]
        )
