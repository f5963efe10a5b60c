"""What turns the numbers and pictures of a scene file into tensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.scene_file.load import SceneFile
from ddrecon.scene_file.schema import SceneTree


@dataclass(frozen=True)
class Maker:
    """Makes tensors of `dtype` on `device` of what `scene_file` says."""

    scene_file: SceneFile
    dtype: torch.dtype = torch.float32
    device: torch.device | str = "cpu"

    @property
    def tree(self) -> SceneTree:
        """The content of the scene file."""
        return self.scene_file.tree

    def tensor(self, value: Any) -> Tensor:
        """`value`, numbers or a tensor."""
        return torch.as_tensor(value, dtype=self.dtype, device=self.device)

    def color(self, name: str, value: Any) -> Tensor:
        """The color `value` of the variable `name`, [1] or [3]; three equal ones are one."""
        return self.tensor(self.tree.share_color(name, value)).view(-1)

    def picture(self, pixels: np.ndarray) -> Tensor:
        """[C, h, w] of `pixels` [h, w, C]."""
        return self.tensor(torch.from_numpy(pixels).permute(2, 0, 1).contiguous())
