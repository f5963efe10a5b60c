"""What a camera does to radiance: exposure, offset and background (E9.1)."""

from dataclasses import replace

import torch
from media import half_empty, make_scene

from ddrecon.renderer import render


def test_an_empty_volume_shows_the_background_as_it_is() -> None:
    """Whatever the camera does: a picture without the medium is such a picture."""
    scene = make_scene(half_empty(4, 5, 6), ambient=(0.3,))
    picture = torch.rand(3, *scene.views[0].camera.size, dtype=torch.float64)
    empty = replace(scene.volume, density=torch.zeros_like(scene.volume.density))
    view = replace(
        scene.views[0],
        background=picture,
        exposure=torch.tensor([1.3, 0.7, 2.0], dtype=torch.float64),
        offset=torch.tensor([0.1], dtype=torch.float64),
    )
    (shown,) = render(replace(scene, volume=empty, views=[view]))
    torch.testing.assert_close(shown, picture)


def test_a_picture_is_exposure_times_radiance_and_offset_and_what_shows_through() -> None:
    scene = make_scene(half_empty(4, 5, 6), ambient=(0.3,))
    view, tensor = scene.views[0], torch.tensor

    def picture(**response: torch.Tensor) -> torch.Tensor:
        values = {name: value.to(torch.float64) for name, value in response.items()}
        return render(replace(scene, views=[replace(view, **values)]))[0]

    zero = torch.zeros(1, 1, 1)
    dark, bright = picture(background=zero), picture(background=zero + 1)
    transmittance = bright - dark
    assert 0 < float(transmittance.min()) < float(transmittance.max()) <= 1 + 1e-12
    shown = picture(background=zero + 0.4, exposure=tensor([1.7]), offset=tensor([0.05]))
    torch.testing.assert_close(
        shown, 1.7 * dark + transmittance * (0.4 - 0.05) + 0.05, rtol=1e-6, atol=1e-6
    )
