"""Exposures and offsets: found exactly where a picture has them, and right ones stay."""

import pytest
import torch
from media import box_grid, make_camera

from ddrecon.losses import Target
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.responses import LARGEST_GAIN, Response, fit_held_out, fit_response
from ddrecon.scene import View
from ddrecon.settings import ParameterSettings


def response(gain: list[float], offset: list[float]) -> Response:
    double = torch.float64
    return Response(
        torch.tensor(gain, dtype=double), torch.tensor(offset, dtype=double), True, True
    )


@pytest.mark.parametrize("loss", ["l2", "display", "photon"])
@pytest.mark.parametrize(
    ("gain", "offset"), [([1.3], [0.02]), ([1.3, 0.8, 1.1], [0.02, 0.0, 0.01]), ([0.7], [0.01] * 3)]
)
def test_the_response_of_a_picture_is_found(
    loss: str, gain: list[float], offset: list[float]
) -> None:
    light, true = 0.5 * torch.rand(3, 12, 10, dtype=torch.float64), response(gain, offset)
    seen = (torch.rand(12, 10, dtype=torch.float64) > 0.2).to(torch.float64)
    image = true.exposure.view(-1, 1, 1) * light + true.offset.view(-1, 1, 1)
    target = Target.of(torch.where(seen > 0, image, 7.0), seen, loss)
    start = response([1.0] * len(gain), [0.0] * len(offset))
    found = fit_response(light, target, start, LARGEST_GAIN)
    torch.testing.assert_close(found.exposure, true.exposure, rtol=1e-4, atol=0)
    torch.testing.assert_close(found.offset, true.offset, rtol=0, atol=1e-5)
    again = fit_response(image, target, true, LARGEST_GAIN)
    torch.testing.assert_close(again.exposure, true.exposure)
    torch.testing.assert_close(again.offset, true.offset)


def test_a_black_render_says_nothing_of_an_exposure() -> None:
    target = Target.of(torch.rand(3, 4, 5, dtype=torch.float64), None)
    start = Response(torch.ones(1).double(), torch.zeros(1).double(), True, False)
    found = fit_response(torch.zeros(3, 4, 5, dtype=torch.float64), target, start, 2.0)
    assert found.exposure.tolist() == [1.0]


def test_a_held_out_picture_is_never_shown_worse_for_its_response() -> None:
    """A haze over a quarter of the black: least squares, which count the dark most, darken all."""
    image = torch.zeros(3, 8, 8, dtype=torch.float64)
    image[:, :, :4] = 0.3
    picture = image.clone()
    picture[:, :, 6:] = 0.05
    target, view = Target.of(image, None, "display"), View("test", make_camera(size=(8, 8)))
    one, grid = torch.ones(1, dtype=torch.float64), box_grid((2, 2, 2))
    sought = [
        Parameter(f"views.other.{key}", ParameterSettings(), 0.1, one, grid)
        for key in ("exposure", "offset")
    ]
    fitted, found = fit_held_out(picture, view, target, sought)
    assert target.psnr_of(fitted) >= target.psnr_of(picture)
    dark = 0.7 * image
    mended, _ = fit_held_out(dark, view, target, sought)
    assert target.psnr_of(mended) > target.psnr_of(dark) + 20
    assert set(found) == {"exposure", "offset"}
