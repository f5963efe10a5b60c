"""A mode that refuses what a GPU adds up in any order: `torch.use_deterministic_algorithms` has it.

What is written to places by index has an order only where a place occurs twice.
"""

from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

UNFIXED = {
    *("avg_pool3d_backward", "_adaptive_avg_pool2d_backward", "_adaptive_avg_pool3d_backward"),
    *("max_pool3d_with_indices_backward", "adaptive_max_pool2d_backward", "convolution_backward"),
    *("upsample_linear1d_backward", "upsample_bilinear2d_backward"),
    *("upsample_bicubic2d_backward", "upsample_trilinear3d_backward"),
    *(f"{kind}_pad{n}d_backward" for kind in ("reflection", "replication") for n in (1, 2, 3)),
    *("grid_sampler_2d_backward", "grid_sampler_3d_backward", "nll_loss_forward", "put", "histc"),
    *("scatter", "scatter_add", "scatter_reduce", "index_reduce", "median", "bincount"),
}


class FixedOrder(TorchDispatchMode):
    """Raises RuntimeError for an operation whose sums have no fixed order on a GPU."""

    def __torch_dispatch__(
        self, function: Any, types: Any, arguments: Any = (), options: Any = None
    ) -> Any:
        name = function._schema.name.removeprefix("aten::")
        plain = name.rstrip("_")
        is_refused = plain in UNFIXED
        if plain == "cumsum":
            is_refused = arguments[0].is_floating_point()
        elif plain in ("index_add", "index_copy"):
            is_refused = not _are_apart([arguments[2]])
        elif plain in ("index_put", "_index_put_impl"):
            # What is added up is sorted before.
            is_refused = not (len(arguments) > 3 and arguments[3]) and not _are_apart(arguments[1])
        if is_refused:
            raise RuntimeError(f"{name} has no fixed order on a GPU")
        return function(*arguments, **(options or {}))


def _are_apart(indices: list[Tensor | None]) -> bool:
    """Whether each place that the `indices` of some axes say occurs once."""
    known = [index for index in indices if index is not None]
    if any(index.dtype == torch.bool for index in known):
        return True
    places = torch.stack([place.flatten() for place in torch.broadcast_tensors(*known)])
    return places.unique(dim=1).shape == places.shape
