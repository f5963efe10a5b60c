"""Where view rays are sampled."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Nodes:
    """N nodes on each of R rays: rays' `origin` and unit `direction` [R, 3] (array order), nodes' `distance` [N, R] from the origin [u]."""

    origin: Tensor
    direction: Tensor
    distance: Tensor

    @property
    def points(self) -> Tensor:
        """World positions `[N, R, 3]`, array order."""
        return self.origin + self.distance[..., None] * self.direction
