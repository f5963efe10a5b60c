"""The exposure and offset of a held-out picture: those that fit it best (E28).

What is found for cameras that were trained on says nothing of another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ddrecon.losses import Target
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.scene import View
from ddrecon.variables.kinds import RESPONSE


def fit_held_out(
    picture: Tensor, view: View, target: Target, parameters: Sequence[Parameter]
) -> tuple[Tensor, dict[str, Tensor]]:
    """The `picture` [3, h, w] of a test `view` with the response that fits its own `target` best.

    And what that is, by key: of exposure and offset those that are `parameters` of training views.
    Least squares count errors in the dark more than PSNR does where pictures are displayed, and may
    do harm to a picture that is far off: then the exposure alone is found, or none.
    """
    sizes = {p.key: len(p.value) for p in parameters if p.view is not None and p.key in RESPONSE}
    exposure, offset = (
        picture.new_full((1,), default) if getattr(view, key) is None else getattr(view, key)
        for key, default in RESPONSE.items()
    )
    known = {"exposure": exposure, "offset": offset}
    light = (picture - offset.view(-1, 1, 1)) / exposure.view(-1, 1, 1)
    tried = [(picture, {key: known[key].expand(size) for key, size in sizes.items()})]
    for keys in (["exposure"], ["offset"], ["exposure", "offset"]):
        if sizes.keys() >= set(keys):
            fit = fit_response(light, target, known, {key: sizes[key] for key in keys})
            shown = fit["exposure"].view(-1, 1, 1) * light + fit["offset"].view(-1, 1, 1)
            tried.append((shown, {key: fit[key].expand(size) for key, size in sizes.items()}))
    return max(tried, key=lambda each: float(target.psnr_of(each[0])))


def fit_response(
    light: Tensor, target: Target, known: Mapping[str, Tensor], sizes: Mapping[str, int]
) -> dict[str, Tensor]:
    """The exposure and offset by which `light` [3, h, w] is nearest to `target`.

    By least squares, weighed as the target's loss weighs small errors. Those in `sizes`, of so many
    entries, 1 or 3, are found; the others are `known`. A background behind the volume counts as if
    it were exposed with it.
    """
    basis = {"exposure": light, "offset": torch.ones_like(light)}
    weight = target.slope if target.seen is None else target.slope * target.seen
    right, columns = target.image, list[Tensor]()
    for key, part in basis.items():
        if key in sizes:
            each = torch.eye(3).to(light) if sizes[key] == 3 else light.new_ones(1, 3)
            columns.append(each[..., None, None] * part)
        else:
            right = right - known[key].view(-1, 1, 1) * part
    matrix = (torch.cat(columns) * weight).flatten(1).double().cpu()
    normal, right = matrix @ matrix.T, matrix @ (right * weight).flatten().double().cpu()
    # What a picture does not show, such as the exposure of black, is 0.
    found = (torch.linalg.pinv(normal, hermitian=True) @ right).to(light)
    return {**known, **dict(zip(sizes, found.split(list(sizes.values())), strict=True))}
