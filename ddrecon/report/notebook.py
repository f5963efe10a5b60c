"""Volumes and scenes in a notebook: the viewer in small, in a frame of its own."""

from __future__ import annotations

from html import escape

from ddrecon.medium.coefficients import Volume
from ddrecon.report.page import page_text
from ddrecon.report.volumes import Shown, describe_volume, describe_world, find_white_value
from ddrecon.scene import Scene

HEIGHT = 640
"""Pixels of the frame."""
FIELDS = ("density", "sigma_a", "sigma_s")


class Drawn(str):
    """HTML that a notebook shows."""

    def _repr_html_(self) -> str:
        return self


def show(shown: Scene | Volume) -> Drawn:
    """The fields of a volume, or of a scene's, to turn and to cut in a notebook.

    A scene is seen from its first camera. The frame's scripts reach nothing of the notebook.
    """
    scene = shown if isinstance(shown, Scene) else None
    volume = shown.volume if isinstance(shown, Scene) else shown
    lights = f"; {len(scene.lights)} lights, {len(scene.views)} views" if scene else ""
    cells = " x ".join(str(count) for count in reversed(volume.grid.shape))
    words = f"{cells} cells, density up to {float(volume.density.detach().max()):.4g}{lights}"
    fields = {name: getattr(volume, name).detach() for name in FIELDS}
    fields = {name: value for name, value in fields.items() if value.ndim >= 3}
    viewed = [
        Shown(name, "result", value, find_white_value(value)) for name, value in fields.items()
    ]
    volume_section = describe_volume(viewed, describe_world(volume.grid, scene))
    page = page_text(title="ddrecon", lead=words, volume=volume_section, is_small=True)
    return Drawn(
        f'<iframe sandbox="allow-scripts" srcdoc="{escape(page)}" title="{escape(words)}" '
        f'style="width: 100%; height: {HEIGHT}px; border: 0"></iframe>'
    )
