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
_bytes_kept: dict[Any, int] = {}
"""What each result takes, by its function's memory and its key in that."""
_copies: WeakValueDictionary[tuple[int, int], Tensor] = WeakValueDictionary()
"""Of tensors that results were computed from, by identity and version."""
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
    def of(tensor: Tensor, forget: Callable[[object], None]) -> _Source:
        key, copy = (id(tensor), version_of(tensor)), None
        if _results.get(id(tensor)) is not tensor:
            copy = _copies.get(key)
            if copy is None or not _is_same(copy, tensor):
                copy = _copies[key] = tensor.detach().clone()
        return _Source(ref(tensor, forget), key[1], copy)

    def is_still(self, other: Tensor) -> bool:
        """Whether `other` is this tensor, unchanged; identities of tensors that went come again."""
        if self.tensor() is not other or self.version != version_of(other):
            return False
        return self.copy is None or _is_same(self.copy, other)


def _is_same(copy: Tensor, tensor: Tensor) -> bool:
    """Whether `tensor`, which has its version yet, has the numbers of `copy`.

    Nobody counts changes through NumPy or `.data`. For numbers on a GPU a processor would wait:
    `forget_changed` looks at these.
    """
    is_alike = (copy.is_cpu, copy.dtype) == (tensor.is_cpu, tensor.dtype)
    return is_alike and (not tensor.is_cpu or torch.equal(copy, tensor))


class _Kept(NamedTuple):
    """A `value`, and what it was computed from."""

    sources: list[_Source]
    value: Any


def remember(function: Callable[P, T]) -> Callable[P, T]:
    """`function`, which is not called again while its arguments are the same and unchanged.

    They are tensors and what can be hashed, by position. Nothing is kept where a tensor is varied.
    The result must share no memory with arguments, and nobody may change it.
    """
    kept: dict[Any, _Kept] = {}
    _memories.append(kept)
    sizes = _bytes_kept  # tensors go later than a module's names do

    def recall(*arguments: Any) -> Any:
        tensors = [one for one in arguments if isinstance(one, Tensor)]
        if not is_steady(*tensors):
            return function(*arguments)  # type: ignore[call-arg]
        key = tuple((id(one),) if isinstance(one, Tensor) else one for one in arguments)
        found = kept.get(key)
        if found is not None and all(map(_Source.is_still, found.sources, tensors)):
            return found.value
        forget(key)
        with torch.inference_mode(False), torch.no_grad():
            value = function(*arguments)  # type: ignore[call-arg]
            sources = [_Source.of(one, lambda _: forget(key)) for one in tensors]
        size = sum(each.untyped_storage().nbytes() for each in _tensors(value))
        if size + sum(sizes.values()) <= MOST_BYTES:
            kept[key], sizes[id(kept), key] = _Kept(sources, value), size
            _results.update((id(each), each) for each in _tensors(value))
        return value

    def forget(key: Any) -> None:
        kept.pop(key, None)
        sizes.pop((id(kept), key), None)

    return cast("Callable[P, T]", functools.wraps(function)(recall))


def forget_changed() -> None:
    """Forgets all results where a tensor on a GPU has changed by `.data`; that takes one read."""
    found = [kept for memory in _memories for kept in [*memory.values()]]  # others may change it
    pairs: dict[torch.device, list[tuple[Tensor, Tensor]]] = {}
    for reference, version, copy in (source for kept in found for source in kept.sources):
        tensor = reference()
        if tensor is None or copy is None or not tensor.is_cuda or version != version_of(tensor):
            continue
        pairs.setdefault(tensor.device, []).append((tensor.detach(), copy))
    for each in pairs.values():
        now, then = (torch.cat([one.flatten() for one in side]) for side in zip(*each, strict=True))
        if not torch.equal(now, then):
            for memory in _memories:
                memory.clear()
            _bytes_kept.clear()


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
