"""The front door from Python: a scene is rendered, by itself or as a layer in a network.

Both look at what they are given; the rooms below take a scene as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor

from ddrecon import lighting, picture
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import UsageError
from ddrecon.numerics.autodiff import leave_uncompiled, refuse_batches, require_plain_autograd
from ddrecon.numerics.remember import forget_changed
from ddrecon.scene import Scene, require_above
from ddrecon.variables.kinds import PAIRS
from ddrecon.variables.values import is_real, require_legal, require_scene, shapes_of, with_values

DTYPES = (torch.float32, torch.float64)
"""What light is computed in."""


def render(scene: Scene, view: str | None = None, memory: SolveMemory | None = None) -> Tensor:
    """Pictures `[views, 3, h, w]`, as `ddrecon.picture.render` has them, of a legal `scene`.

    Raises UsageError where `require_legal` does.
    """
    _prepare(scene, view)
    return refuse_batches(picture.render(scene, view, memory))


def fluence(scene: Scene, memory: SolveMemory | None = None) -> Tensor:
    """The fluence `[C, z, y, x]`, as `ddrecon.lighting.fluence` has it; raises as `render`."""
    _prepare(scene, None)
    return refuse_batches(lighting.fluence(scene, memory))


def _prepare(scene: Scene, view: str | None) -> None:
    """Raises where a `view` of `scene` cannot be rendered, and notices what changed in it."""
    require_plain_autograd()
    require_legal(scene, view)
    if scene.volume.density.is_cpu:
        require_above(scene)
    scene.settle()
    forget_changed()


class VolumeRenderer(torch.nn.Module):
    """Renders the views of `scene`, with fields of its caller in place of the scene's own.

    The scene's tensors move with the layer (`to`, `cuda`, `double`), and what it is given is
    taken to their precision, also under autocast. Solutions are remembered from one call to the
    next as starting points, unless `scene.diffusion.warm_start` is off.
    """

    def __init__(self, scene: Scene):
        super().__init__()
        require_scene(scene)
        self.scene = scene
        self.memories: list[SolveMemory] = []

    def extra_repr(self) -> str:
        """The scene, in few words."""
        return repr(self.scene)

    @leave_uncompiled
    def forward(
        self,
        density: Tensor | None = None,
        sigma_a: Tensor | None = None,
        sigma_s: Tensor | None = None,
        g: Tensor | None = None,
        view: str | None = None,
        values: Mapping[str, Tensor] | None = None,
    ) -> Tensor:
        """Images `[views, 3, h, w]` of all views, or of the one named `view`.

        `density`: [z, y, x] >= 0; `sigma_a`, `sigma_s` [1/u]: `[C]` or `[C, z, y, x]`; `g`: scalar
        in (-1, 1); `values`: anything else by name, such as `lights.0.irradiance`
        (`ddrecon.variables`). What is None is the scene's. With one more axis in front, of n
        entries, images are `[n, views, 3, h, w]`. Raises UsageError for a name the scene does not
        have, for other shapes, another device, and where `render` does; NotImplementedError within
        `torch.func.vmap` or `torch.func.grad`.
        """
        named = {"density": density, "sigma_a": sigma_a, "sigma_s": sigma_s, "g": g}
        inputs = {name: value for name, value in named.items() if value is not None}
        if twice := inputs.keys() & (values or {}):
            raise UsageError(f"{min(twice)}: given twice, by its own name and in values")
        inputs |= values or {}
        if all(inputs.keys() & pair for pair in PAIRS):
            names = ", ".join(sorted(inputs))
            raise UsageError(f"{names}: give sigma_a and sigma_s, or sigma_t and albedo, not both")
        like = self.scene.volume.density
        with torch.autocast("cpu" if like.is_meta else like.device.type, enabled=False):
            inputs = {n: v.to(like.dtype) if is_real(v) else v for n, v in inputs.items()}
            counts = {name: len(v) for name, v in inputs.items() if self._is_batch(name, v)}
            if len(set(counts.values())) > 1 or 0 in counts.values():
                raise UsageError(f"batches differ in size, or hold nothing: {counts}")
            count, images = next(iter(counts.values()), 1), []
            # Each entry starts from its own last solutions.
            while len(self.memories) < count:
                self.memories.append(SolveMemory(self.scene.diffusion.warm_start))
            for index, memory in enumerate(self.memories[:count]):
                memory.records.clear()
                entry = {n: v[index] if n in counts else v for n, v in inputs.items()}
                images.append(render(with_values(self.scene, entry), view, memory))
            return torch.stack(images) if counts else images[0]

    if TYPE_CHECKING:
        __call__ = forward  # which torch's own class says nothing of

    def _is_batch(self, name: str, value: Tensor) -> bool:
        """Whether `value` has an axis of entries in front of what the variable `name` may have."""
        if not isinstance(value, Tensor):
            return False
        shapes, shape = shapes_of(self.scene, name), tuple(value.shape)
        return shape not in shapes and shape[1:] in shapes

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """What torch calls to move a module: the scene's tensors are moved as well."""
        module: Self = super()._apply(fn, recurse)
        scene = _map_tensors(fn, self.scene)
        if scene.volume.density.dtype not in DTYPES:
            raise UsageError(
                f"light is not computed in {scene.volume.density.dtype}; leave the layer in "
                "float32 or float64, what it is given may be of any precision"
            )
        self.scene, self.memories = scene, []
        return module


def _map_tensors(fn: Callable[[Tensor], Tensor], record: Any) -> Any:
    """`record` with `fn` of each tensor in it; leaves stay leaves."""
    if isinstance(record, Tensor):
        return fn(record.detach()).requires_grad_(record.requires_grad)
    if isinstance(record, list):
        return [_map_tensors(fn, entry) for entry in record]
    if isinstance(record, dict):
        return {key: _map_tensors(fn, entry) for key, entry in record.items()}
    if is_dataclass(record) and not isinstance(record, type):
        keys = [key.name for key in fields(record) if key.init]
        return replace(record, **{key: _map_tensors(fn, getattr(record, key)) for key in keys})
    return record
