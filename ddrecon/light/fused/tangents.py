"""Tangents of the light of beams: the kernels of its values, in dual numbers (`kernels.dual`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor

from ddrecon.kernels.dual import tangent_of, with_changes
from ddrecon.light.fused.receive import MOMENTS, Receiver, receive_kernel


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
