"""What a camera does to radiance: exposure, offset and background (E9.1)."""

from dataclasses import replace

import torch
from media import half_empty, make_scene, tensor

from ddrecon.picture import render


def test_an_empty_volume_shows_the_background_as_it_is() -> None:
    """Whatever the camera does: a picture without the medium is such a picture."""
    scene = make_scene(half_empty(4, 5, 6), ambient=(0.3,))
    picture = torch.rand(3, *scene.views[0].camera.size, dtype=torch.float64)
    empty = replace(scene.volume, density=torch.zeros_like(scene.volume.density))
    response = {"exposure": tensor(1.3, 0.7, 2.0), "offset": tensor(0.1)}
    view = replace(scene.views[0], background=picture, **response)
    (shown,) = render(replace(scene, volume=empty, views=[view]))
    torch.testing.assert_close(shown, picture)


def test_a_picture_is_exposure_times_radiance_and_offset_and_what_shows_through() -> None:
    scene = make_scene(half_empty(4, 5, 6), ambient=(0.3,))
    view, zero = scene.views[0], tensor(0).view(1, 1, 1)

    def picture(**response: torch.Tensor) -> torch.Tensor:
        return render(replace(scene, views=[replace(view, **response)]))[0]

    dark, bright = picture(background=zero), picture(background=zero + 1)
    transmittance = bright - dark
    assert 0 < float(transmittance.min()) < float(transmittance.max()) <= 1 + 1e-12
    shown = picture(background=zero + 0.4, exposure=tensor(1.7), offset=tensor(0.05))
    expected = 1.7 * dark + transmittance * (0.4 - 0.05) + 0.05
    torch.testing.assert_close(shown, expected, rtol=1e-6, atol=1e-6)
