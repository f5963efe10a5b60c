"""Results that are kept as long as the tensors stay that they were computed from.

What a scene fixes needs no second look: each small operation costs some microseconds, and for a
number that Python reads a processor waits for a GPU.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from typing import Any, NamedTuple, ParamSpec, TypeVar, cast
from weakref import ref

import torch
from torch import Tensor

from ddrecon.numerics.autodiff import is_steady, version_of

P = ParamSpec("P")
T = TypeVar("T")
MOST_BYTES = 1 << 29
"""So much is kept of all functions together; other results are found again each time."""
_bytes_kept: dict[int, int] = {}
"""Of each result that is kept, by its identity."""


class _Kept(NamedTuple):
    """A `value`, and which tensors it was computed from, and how often these had been changed."""

    tensors: list[ref[Tensor]]
    versions: list[int]
    value: Any

    def is_of(self, tensors: Sequence[Tensor]) -> bool:
        """Whether they are these, unchanged; an identity is used again when its tensor is gone."""
        return all(
            one() is other and version == version_of(other)
            for one, version, other in zip(self.tensors, self.versions, tensors, strict=True)
        )


def remember(function: Callable[P, T]) -> Callable[P, T]:
    """`function`, which is not called again while its arguments are the same and unchanged.

    They are tensors and what can be hashed, by position. Nothing is kept where a tensor is varied.
    The result must share no memory with arguments, and nobody may change it.
    """
    kept: dict[Any, _Kept] = {}

    def recall(*arguments: Any) -> Any:
        tensors = [one for one in arguments if isinstance(one, Tensor)]
        if not is_steady(*tensors):
            return function(*arguments)  # type: ignore[call-arg]
        key = tuple((id(one),) if isinstance(one, Tensor) else one for one in arguments)
        found = kept.get(key)
        if found is not None and found.is_of(tensors):
            return found.value
        forget(key)
        with torch.inference_mode(False), torch.no_grad():
            value = function(*arguments)  # type: ignore[call-arg]
        size = _bytes(value)
        if size + sum(_bytes_kept.values()) <= MOST_BYTES:
            references = [ref(one, lambda _: forget(key)) for one in tensors]
            kept[key] = _Kept(references, [version_of(one) for one in tensors], value)
            _bytes_kept[id(value)] = size
        return value

    def forget(key: Any) -> None:
        if (found := kept.pop(key, None)) is not None:
            _bytes_kept.pop(id(found.value), None)

    return cast("Callable[P, T]", functools.wraps(function)(recall))


def _bytes(value: object) -> int:
    """What the tensors in `value` take."""
    if isinstance(value, tuple):
        return sum(map(_bytes, value))
    if is_dataclass(value):
        return _bytes(tuple(vars(value).values()))
    return value.untyped_storage().nbytes() if isinstance(value, Tensor) else 0


@remember
def is_any_nonzero(tensor: Tensor) -> bool:
    """Whether one of the numbers of `tensor` is not 0."""
    return bool((tensor != 0).any())
