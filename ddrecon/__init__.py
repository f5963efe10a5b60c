"""ddrecon: density volumes from pictures of smoke and clouds, by differential diffusion.

`load_scene(path) -> Scene`, `render(scene, view=None) -> Tensor [views, 3, h, w]`, `optimize(scene,
...) -> Result`, of films `optimize_sequence(path, ...) -> Iterator[Result]`, and `VolumeRenderer`,
the renderer as a layer. Names are imported when first used, so that `import ddrecon` costs nothing.
"""

from importlib import import_module
from typing import Any

from ddrecon.display import Displayed

__version__ = "0.1.0"
_HOMES = {
    "load_scene": "ddrecon.scene_file.build",
    "render": "ddrecon.layer",
    "fluence": "ddrecon.layer",
    "VolumeRenderer": "ddrecon.layer",
    "optimize": "ddrecon.reconstruct.loop",
    "optimize_sequence": "ddrecon.film.drive",
    "Result": "ddrecon.reconstruct.loop",
    "Scene": "ddrecon.scene",
    "use_engine": "ddrecon.engine",
    "DdreconError": "ddrecon.errors",
    "SceneError": "ddrecon.errors",
    "UsageError": "ddrecon.errors",
    "FormatError": "ddrecon.errors",
    "SolveError": "ddrecon.errors",
}
__all__ = ["__version__", *_HOMES]


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'ddrecon' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def _draw(record: Any) -> str:
    """A scene or a volume in a notebook."""
    from ddrecon.report.notebook import html_of

    return html_of(record)


Displayed._repr_html_ = _draw
