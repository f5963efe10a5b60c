"""Results that are kept as long as the tensors stay that they were computed from.

What a scene fixes needs no second look: each small operation costs some microseconds, and for a
number that Python reads a processor waits for a GPU.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from typing import Any, NamedTuple, ParamSpec, TypeVar, cast
from weakref import WeakValueDictionary, ref

import torch
from torch import Tensor

from ddrecon.numerics.autodiff import is_steady, version_of

P = ParamSpec("P")
T = TypeVar("T")
MOST_BYTES = 1 << 29
"""So much is kept of all functions together; other results are found again each time."""
_results: WeakValueDictionary[int, Tensor] = WeakValueDictionary()
"""The tensors in results, by identity: nobody changes these."""
_memories: list[dict[Any, _Kept]] = []
"""Of each function, what is kept of it."""


class _Source(NamedTuple):
    """A tensor, how often it had been changed, and a copy of it; None of one in a result."""

    tensor: ref[Tensor]
    version: int
    copy: Tensor | None

    @staticmethod
    def of(tensor: Tensor, forget: Callable[[object], object]) -> _Source:
        copy = None if _results.get(id(tensor)) is tensor else tensor.detach().clone()
        return _Source(ref(tensor, forget), version_of(tensor), copy)

    def is_still(self, other: Tensor) -> bool:
        """Whether `other` is this tensor, unchanged; identities of tensors that went come again.

        Nobody counts changes through NumPy or `.data`, so numbers are compared: of those on a GPU,
        for which a processor would wait, by `forget_changed`.
        """
        if self.tensor() is not other or self.version != version_of(other):
            return False
        if self.copy is None or not other.is_cpu:
            return True
        return self.copy.dtype == other.dtype and torch.equal(self.copy, other)


class _Kept(NamedTuple):
    """A `value`, what it was computed from, and how many bytes both take."""

    sources: list[_Source]
    value: Any
    size: int


def remember(function: Callable[P, T]) -> Callable[P, T]:
    """`function`, which is not called again while its arguments are the same and unchanged.

    They are tensors and what can be hashed, by position. Nothing is kept where a tensor is varied.
    The result must share no memory with arguments, and nobody may change it.
    """
    kept: dict[Any, _Kept] = {}
    _memories.append(kept)

    def recall(*arguments: Any) -> Any:
        tensors = [one for one in arguments if isinstance(one, Tensor)]
        if not is_steady(*tensors):
            return function(*arguments)  # type: ignore[call-arg]
        key = tuple((id(one),) if isinstance(one, Tensor) else one for one in arguments)
        found = kept.get(key)
        if found is not None and all(map(_Source.is_still, found.sources, tensors)):
            return found.value
        kept.pop(key, None)
        with torch.inference_mode(False), torch.no_grad():
            value = function(*arguments)  # type: ignore[call-arg]
            sources = [_Source.of(one, lambda _: kept.pop(key, None)) for one in tensors]
        size = sum(each.untyped_storage().nbytes() for each in _tensors((value, *sources)))
        if size + sum(each.size for memory in _memories for each in memory.values()) <= MOST_BYTES:
            kept[key] = _Kept(sources, value, size)
            _results.update((id(each), each) for each in _tensors(value))
        return value

    return cast("Callable[P, T]", functools.wraps(function)(recall))


def forget_changed() -> None:
    """Forgets all results where a tensor on a GPU has changed by `.data`; that takes one read."""
    sources = [one for memory in _memories for kept in memory.values() for one in kept.sources]
    pairs = [
        (tensor.detach().flatten(), copy.flatten())
        for tensor, version, copy in ((one.tensor(), *one[1:]) for one in sources)
        if tensor is not None and tensor.is_cuda and copy is not None
        if version == version_of(tensor)
    ]
    if pairs and not torch.equal(*map(torch.cat, zip(*pairs, strict=True))):
        for memory in _memories:
            memory.clear()


def _tensors(value: object) -> Iterator[Tensor]:
    """The tensors in `value`."""
    if isinstance(value, Tensor):
        yield value
    elif is_dataclass(value) or isinstance(value, tuple):
        for part in value if isinstance(value, tuple) else vars(value).values():
            yield from _tensors(part)


@remember
def is_any_nonzero(tensor: Tensor) -> bool:
    """Whether one of the numbers of `tensor` is not 0."""
    return bool((tensor != 0).any())
