"""Volumes and scenes in a notebook: the viewer in small, in a frame of its own."""

from __future__ import annotations

from html import escape

from ddrecon.io.images.table import png_of
from ddrecon.medium.coefficients import Volume
from ddrecon.report.page import page_text, picture
from ddrecon.report.pictures import slices
from ddrecon.report.volumes import Shown, find_white_value, volume_viewer
from ddrecon.scene import Scene
from ddrecon.turntable import upright_axis

HEIGHT = 620
"""Pixels of the frame."""
SIDEWAYS = (0.5, 0.4, 1.0)
"""Where a volume without cameras is looked at from."""
FIELDS = ("density", "sigma_a", "sigma_s")


def html_of(shown: Scene | Volume) -> str:
    """A frame with the fields of a volume, or of a scene's, to turn and to cut."""
    if isinstance(shown, Volume):
        return _frame(shown, _describe(shown), 1, SIDEWAYS)
    return _scene_html(shown)


def _scene_html(scene: Scene) -> str:
    """A frame with the volume of `scene`, seen from its first camera, and a line about it."""
    words = f"{_describe(scene.volume)}; {len(scene.lights)} lights, {len(scene.views)} views"
    if not scene.views:
        return _frame(scene.volume, words, 1, SIDEWAYS)
    cameras = [view.camera for view in scene.views]
    pose = cameras[0].pose.detach()
    x, y, z = (pose[:, 3] - pose.new_tensor(scene.volume.grid.center_xyz)).tolist()
    return _frame(scene.volume, words, upright_axis(cameras), (x, y, z))


def _describe(volume: Volume) -> str:
    cells = " x ".join(str(count) for count in reversed(volume.grid.shape))
    return f"{cells} cells, density up to {float(volume.density.detach().max()):.4g}"


def _frame(volume: Volume, words: str, up: int, towards_eye: tuple[float, float, float]) -> str:
    """The page in a frame whose scripts reach nothing of the notebook."""
    fields = {name: getattr(volume, name).detach() for name in FIELDS}
    fields = {name: value for name, value in fields.items() if value.ndim >= 3}
    z, y, x = volume.grid.extent
    shown = [
        Shown(name, "result", value, (x, y, z), find_white_value(value))
        for name, value in fields.items()
    ]
    still = "".join(picture(png_of(slices(value)), name) for name, value in fields.items())
    viewer = volume_viewer(shown, still, up, towards_eye)
    page = page_text("ddrecon", words, [viewer], is_alive=True)
    return (
        f'<iframe sandbox="allow-scripts" srcdoc="{escape(page)}" title="{escape(words)}" '
        f'style="width: 100%; height: {HEIGHT}px; border: 0"></iframe>'
    )
