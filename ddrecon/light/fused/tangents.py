"""Tangents of the light of beams: the kernels of its values, in dual numbers (`kernels.dual`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ddrecon.kernels.dual import interleaved_tangent_of, pair, tangent_of, with_changes
from ddrecon.light.fused.receive import MOMENTS, Receiver, receive_kernel
from ddrecon.light.fused.shear import Shear, shear_kernels
from ddrecon.light.fused.shear_slabs import SlabShear


class BeamTangents:
    """The mass that beams pass in a `field` [K, z, y, x], and how that changes with `d_field`.

    `numbers` [L, 4] of L beams, as `shear.Sum` has them; of `d_numbers` that of the bound counts.
    """

    def __init__(
        self, field: Tensor, d_field: Tensor | None, numbers: Tensor, d_numbers: Tensor | None
    ):
        self.field = field
        self.d_field = torch.zeros_like(field) if d_field is None else d_field
        self.numbers = pair(numbers, d_numbers)

    def follow(self, shear: Shear | SlabShear, light: int) -> tuple[Tensor, Tensor]:
        """The mass up to where beam number `light` enters cells [K, z, y, x], and its change."""
        if isinstance(shear, SlabShear):
            both = shear.follow_tangent(self.field, self.d_field, self.numbers, light)
            return both[..., 0].contiguous(), both[..., 1].contiguous()
        laid = pair(shear.lay(self.field), shear.lay(self.d_field))
        kernels = shear_kernels(laid.element_size() * 8)
        entered = torch.empty_like(laid)
        masses = laid.new_empty(2 * len(laid) * shear.window)
        given = shear.record | {"light": light, "numbers": self.numbers, "field": laid}
        rays, cells = shear.items(laid)
        interleaved_tangent_of(kernels.rays).launch(rays, given, {"masses": masses})
        given["masses"] = masses
        interleaved_tangent_of(kernels.cells).launch(cells, given, {"entered": entered})
        value, change = entered.unbind(-1)
        return shear.lift(value.contiguous()), shear.lift(change.contiguous())


def change_received(
    receiver: Receiver,
    light: int,
    entered: Tensor,
    changes: Mapping[str, Tensor | None],
    d_moments: Sequence[Tensor],
) -> None:
    """Writes the changes of what is received of beams from number `light` on to `d_moments`.

    Of beams but the first it adds them. `entered` [n, K, z, y, x], as of `Receiver.receive`;
    `changes` by the names of `Receiver.given`, and of `entered`.
    """
    own = {"light": light, "lights": len(entered), "adds": light > 0, "entered": entered}
    given = receiver.given | own
    kernel = tangent_of(receive_kernel(receiver.bits))
    made = {f"d_{name}": one for name, one in zip(MOMENTS, d_moments, strict=False)}
    kernel.launch(receiver.items, given | with_changes(given, changes), made)
