"""ddrecon: density volumes from pictures of smoke and clouds, by differential diffusion.

`load_scene(path) -> Scene`, `render(scene, view=None) -> Tensor [views, 3, h, w]`, `optimize(scene,
...) -> Result`, of films `optimize_sequence(path, ...) -> Iterator[Result]`, and `VolumeRenderer`,
the renderer as a layer; `show(scene)` draws it in a notebook. Names are imported when first used,
so that `import ddrecon` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
_HOMES = {
    "load_scene": "scene_file.build",
    "render": "layer",
    "fluence": "layer",
    "VolumeRenderer": "layer",
    "optimize": "reconstruct.loop",
    "show": "report.volumes",
    "optimize_sequence": "film",
    "Result": "reconstruct.frame",
    "Scene": "scene",
    "use_engine": "engine",
    "DdreconError": "errors",
    "SceneError": "errors",
    "UsageError": "errors",
    "FormatError": "errors",
    "SolveError": "errors",
}
__all__ = ["__version__", *_HOMES]

if TYPE_CHECKING:
    from ddrecon.engine import use_engine as use_engine
    from ddrecon.errors import DdreconError as DdreconError
    from ddrecon.errors import FormatError as FormatError
    from ddrecon.errors import SceneError as SceneError
    from ddrecon.errors import SolveError as SolveError
    from ddrecon.errors import UsageError as UsageError
    from ddrecon.film import optimize_sequence as optimize_sequence
    from ddrecon.layer import VolumeRenderer as VolumeRenderer
    from ddrecon.layer import fluence as fluence
    from ddrecon.layer import render as render
    from ddrecon.reconstruct.frame import Result as Result
    from ddrecon.reconstruct.loop import optimize as optimize
    from ddrecon.report.volumes import show as show
    from ddrecon.scene import Scene as Scene
    from ddrecon.scene_file.build import load_scene as load_scene
else:  # where names are unknown to a type checker, they are wrong

    def __getattr__(name: str) -> Any:
        if name not in _HOMES:
            raise AttributeError(f"module 'ddrecon' has no attribute {name!r}")
        return getattr(import_module(f"ddrecon.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
