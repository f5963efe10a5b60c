"""Names for all training views: each is named, but test views, and its own settings win."""

import torch

from ddrecon.cameras import Camera, look_at
from ddrecon.scene import View
from ddrecon.variables.values import name_each


def view(name: str, is_test: bool = False, has_image: bool = True) -> View:
    pose = look_at(*torch.tensor([[0.0, 0, 5], [0, 0, 0], [0, 1, 0]]))
    image = torch.zeros(3, 2, 2) if has_image else None
    return View(name, Camera(pose, (2, 2), 0.3), image, is_test=is_test)


def test_a_star_is_every_training_view_with_an_image() -> None:
    views = [view("a"), view("b.c"), view("held", is_test=True), view("d", has_image=False)]
    named = name_each({"density": 1, "views.*.exposure": 2}, views)
    assert named == {"density": 1, "views.a.exposure": 2, "views.b.c.exposure": 2}


def test_the_settings_of_a_view_itself_win() -> None:
    views = [view("a"), view("b")]
    for parameters in (
        {"views.*.camera": 1, "views.b.camera": 2},
        {"views.b.camera": 2, "views.*.camera": 1},
    ):
        assert name_each(parameters, views) == {"views.a.camera": 1, "views.b.camera": 2}
