"""Exposures and offsets: found exactly where a picture has them, and right ones stay."""

import pytest
import torch
from media import make_camera

from ddrecon.losses import Target
from ddrecon.reconstruct.objective import fit_held_out
from ddrecon.scene import View


@pytest.mark.parametrize("loss", ["l2", "display", "photon"])
@pytest.mark.parametrize(
    ("gain", "offset"), [([1.3], [0.02]), ([1.3, 0.8, 1.1], [0.02, 0.0, 0.01]), ([0.7], [0.01] * 3)]
)
def test_the_response_of_a_picture_is_found(loss, gain, offset):
    """Whatever response it was rendered with, and whatever a mask hides."""
    light = 0.5 * torch.rand(3, 12, 10, dtype=torch.float64)
    true = {"exposure": torch.tensor(gain).double(), "offset": torch.tensor(offset).double()}
    seen = (torch.rand(12, 10, dtype=torch.float64) > 0.2).to(torch.float64)
    image = true["exposure"].view(-1, 1, 1) * light + true["offset"].view(-1, 1, 1)
    target = Target.of(torch.where(seen > 0, image, 7.0), seen, loss)
    one = torch.ones(1).double()
    view = View("test", make_camera(size=(12, 10)), exposure=0.8 * one, offset=0.1 * one)
    sizes = {key: len(value) for key, value in true.items()}
    fitted, found = fit_held_out(0.8 * light + 0.1, view, target, sizes)
    torch.testing.assert_close(fitted, image, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(found, true, rtol=1e-4, atol=1e-5)


def test_a_black_render_keeps_its_response():
    target, view = Target.of(torch.rand(3, 4, 5).double(), None), View("test", make_camera())
    _, found = fit_held_out(torch.zeros(3, 4, 5).double(), view, target, {"exposure": 1})
    assert found["exposure"].tolist() == [1.0]


def test_a_held_out_picture_is_never_shown_worse_for_its_response():
    """A haze over a quarter of the black: least squares, which count the dark most, darken all."""
    image = torch.zeros(3, 8, 8, dtype=torch.float64)
    image[:, :, :4] = 0.3
    picture = image.clone()
    picture[:, :, 6:] = 0.05
    target, view = Target.of(image, None, "display"), View("test", make_camera(size=(8, 8)))
    known = {"exposure": 1, "offset": 1}
    fitted, found = fit_held_out(picture, view, target, known)
    assert target.psnr_of(fitted) >= target.psnr_of(picture)
    dark = 0.7 * image
    mended, _ = fit_held_out(dark, view, target, known)
    assert target.psnr_of(mended) > target.psnr_of(dark) + 20
    assert set(found) == {"exposure", "offset"}
