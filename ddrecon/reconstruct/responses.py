"""What cameras do to radiance, found from pictures: exposures and offsets that fit best.

A picture is linear in both (E28), so that they need no slow descent: for a volume as it is, they
are the solution of a small least-squares problem. A volume whose cameras answer at once does not
learn their exposures as differences between its sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ddrecon.losses import Target
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.scene import View
from ddrecon.variables.values import RESPONSE

LARGEST_STEP = 2.0
"""An exposure changes at most by this factor in a step: a volume may still be nearly empty."""
LARGEST_GAIN = 100.0
"""The same where a picture is only reported."""
PART = 0.5
"""How far a step goes."""
SWEEPS = 32
"""Times that exposure and offset are found in turn, each for the other as it is."""


@dataclass(frozen=True)
class Response:
    """What a camera makes of radiance: `exposure` times it plus `offset`, each [1] or [3].

    `has_gain` and `has_offset` say which of them are sought.
    """

    exposure: Tensor
    offset: Tensor
    has_gain: bool
    has_offset: bool


def fit_response(picture: Tensor, target: Target, response: Response, largest: float) -> Response:
    """The response that takes `picture` [3, h, w], rendered with `response`, nearest to `target`.

    Nearest by least squares, weighed as the target's loss weighs small errors; the exposure changes
    by a factor of at most `largest`. A background behind the volume counts as if it were exposed
    with it; what is found is right where nothing changes.
    """
    # The sums of the normal equations by color, over pixels that count.
    light = picture.detach() - response.offset.detach().view(-1, 1, 1)
    weight = target.slope.square().expand_as(light)
    weight = weight if target.seen is None else weight * target.seen
    products = [weight, weight * light, weight * light * light]
    products += [weight * target.image, weight * light * target.image]
    sums = torch.stack(products).double().sum((-2, -1)).cpu()
    w, wx, wxx, wt, wxt = sums
    gain, offset = torch.ones(3).double(), response.offset.detach().double().cpu().expand(3)
    for _ in range(SWEEPS if response.has_gain and response.has_offset else 1):
        if response.has_gain:
            gain = _quotient(wxt - offset * wx, wxx, response.exposure, gain)
            gain = gain.clamp(1 / largest, largest)
        if response.has_offset:
            offset = _quotient(wt - gain * wx, w, response.offset, offset)
    like, colors, shifts = response.exposure, len(response.exposure), len(response.offset)
    return Response(
        response.exposure.detach() * gain[:colors].to(like),
        offset[:shifts].to(like),
        response.has_gain,
        response.has_offset,
    )


def fit_held_out(
    picture: Tensor, view: View, target: Target, parameters: Sequence[Parameter]
) -> tuple[Tensor, dict[str, Tensor]]:
    """The `picture` [3, h, w] of a test `view` with the response that fits its own `target` best.

    And what that is, by key: of exposure and offset those that are `parameters` of training views,
    for these say nothing of the camera of a test view. Nothing changes where there are none. Least
    squares count errors in the dark more than PSNR does where pictures are displayed, and may do
    harm to a picture that is far off: then the exposure alone is found, or none.
    """
    sizes = {
        parameter.key: len(parameter.value)
        for parameter in parameters
        if parameter.view is not None and parameter.key in RESPONSE
    }
    if not sizes:
        return picture, {}
    exposure, offset = (
        _value(getattr(view, key), default, picture).expand(sizes.get(key, -1))
        for key, default in RESPONSE.items()
    )
    response = Response(exposure, offset, "exposure" in sizes, "offset" in sizes)
    tried = [
        (picture, response),
        _answer(picture, replace(response, has_offset=False), target),
        _answer(picture, response, target),
    ]
    best, found = max(tried, key=lambda each: float(target.psnr_of(each[0])))
    return best, {key: getattr(found, key) for key in sizes}


def _answer(picture: Tensor, response: Response, target: Target) -> tuple[Tensor, Response]:
    """The `picture` [3, h, w] with the response that fits its `target` best, and that response."""
    found = fit_response(picture, target, response, LARGEST_GAIN)
    light = picture - response.offset.view(-1, 1, 1)
    gain = (found.exposure / response.exposure).view(-1, 1, 1)
    return gain * light + found.offset.view(-1, 1, 1), found


def step_responses(
    fitted: Sequence[Parameter], view: View, picture: Tensor, target: Target
) -> None:
    """Takes the parameters `fitted` of a `view` part of the way to what fits its `picture` best."""
    if not fitted:
        return
    keys = {parameter.key: parameter for parameter in fitted}
    like = view.camera.pose
    exposure, offset = (
        keys[key].value if key in keys else _value(getattr(view, key), default, like)
        for key, default in RESPONSE.items()
    )
    response = Response(exposure, offset, "exposure" in keys, "offset" in keys)
    found = fit_response(picture, target, response, LARGEST_STEP)
    for key, parameter in keys.items():
        before, after = parameter.value.detach(), getattr(found, key)
        value = before.lerp(after, PART).clamp(parameter.low, parameter.high)
        parameter.value = value.requires_grad_()


def _value(value: Tensor | None, default: float, like: Tensor) -> Tensor:
    return like.new_full((1,), default) if value is None else value


def _quotient(above: Tensor, below: Tensor, like: Tensor, otherwise: Tensor) -> Tensor:
    """`above` over `below` by color, [3]; of their sums where `like` has one value for all.

    `otherwise` where there is nothing to divide by.
    """
    if len(like) == 1:
        above, below = above.sum().expand(3), below.sum().expand(3)
    tiny = torch.finfo(torch.float32).tiny
    return torch.where(below > tiny, above / below.clamp(min=tiny), otherwise)
