"""Results that are kept as long as the tensors stay that they were computed from.

What a scene fixes needs no second look: each small operation costs some microseconds, and for a
number that Python reads a processor waits for a GPU.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import Any, NamedTuple, ParamSpec, TypeVar, cast
from weakref import WeakValueDictionary, ref

import torch
from torch import Tensor

from ddrecon.numerics.autodiff import is_steady, tensors_in, version_of

P = ParamSpec("P")
T = TypeVar("T")
MOST_BYTES = 1 << 29
"""So much is remembered of all functions together; other results are computed each time."""
_memory: dict[Any, _Result] = {}
"""Results of all functions, by function and arguments."""
_copies: WeakValueDictionary[tuple[int, int], Tensor] = WeakValueDictionary()
"""Of tensors that results were computed from, by identity and version."""
_in_results: WeakValueDictionary[int, Tensor] = WeakValueDictionary()
"""The tensors in results, by identity: nobody changes these."""


class _Source(NamedTuple):
    """A tensor, how often it had been changed, and a copy of it; None of one in a result."""

    reference: ref[Tensor]
    version: int
    copy: Tensor | None

    @staticmethod
    def of(tensor: Tensor, forget: Callable[[object], None]) -> _Source:
        key, copy = (id(tensor), version_of(tensor)), None
        if _in_results.get(id(tensor)) is not tensor:
            copy = _copies.get(key)
            if copy is None or not _has_numbers(tensor, copy):
                copy = _copies[key] = tensor.detach().clone()
        return _Source(ref(tensor, forget), key[1], copy)

    def is_still(self, tensor: Tensor) -> bool:
        """Whether it is `tensor`, unchanged; identities of tensors that went come again."""
        if self.reference() is not tensor or self.version != version_of(tensor):
            return False
        return self.copy is None or _has_numbers(tensor, self.copy)


def _has_numbers(tensor: Tensor, copy: Tensor) -> bool:
    """Whether `tensor`, which has its version yet, has the numbers of `copy`.

    Nobody counts changes through NumPy or `.data`. For numbers on a GPU a processor would wait:
    `forget_changed` looks at these.
    """
    is_alike = (copy.is_cpu, copy.dtype) == (tensor.is_cpu, tensor.dtype)
    return is_alike and (not tensor.is_cpu or torch.equal(copy, tensor))


class _Result(NamedTuple):
    """A `value` with its tensors' `size` in bytes, and what it was computed from."""

    sources: list[_Source]
    value: Any
    size: int


def remember(function: Callable[P, T]) -> Callable[P, T]:
    """`function`, which is not called again while its arguments are the same and unchanged.

    They are tensors, records of tensors, and what can be hashed, by position. Nothing is remembered
    where a tensor is varied. The result must share no memory with arguments, and nobody may change
    it.
    """
    memory = _memory  # tensors go later than a module's names do

    def recall(*arguments: Any) -> Any:
        tensors = list[Tensor]()
        key = function, *[_identify(argument, tensors) for argument in arguments]
        if not is_steady(*tensors):
            return function(*arguments)  # type: ignore[call-arg]
        result = memory.get(key)
        if result is not None and all(map(_Source.is_still, result.sources, tensors)):
            return result.value

        def forget(_: object) -> None:
            memory.pop(key, None)

        forget(key)
        with torch.inference_mode(False), torch.no_grad():
            value = function(*arguments)  # type: ignore[call-arg]
            sources = [_Source.of(tensor, forget) for tensor in tensors]
        results = {id(tensor): tensor for tensor in tensors_in(value)}
        size = sum(tensor.untyped_storage().nbytes() for tensor in results.values())
        # A list, since other threads may change the memory.
        if size + sum(result.size for result in [*memory.values()]) <= MOST_BYTES:
            memory[key] = _Result(sources, value, size)
            _in_results.update(results)
        return value

    return cast("Callable[P, T]", functools.wraps(function)(recall))


def _identify(argument: Any, tensors: list[Tensor]) -> Any:
    """What of an `argument` can be hashed, with its `tensors` in their order."""
    if isinstance(argument, Tensor):
        tensors.append(argument)
        return (id(argument),)
    kind: Any = type(argument)
    names = _fields_of(kind)
    if names is None:
        return argument
    return kind, *[_identify(getattr(argument, name), tensors) for name in names]


@functools.cache
def _fields_of(kind: type) -> list[str] | None:
    """The names of the fields of records that cannot be hashed by these."""
    if is_dataclass(kind) and kind.__eq__ is object.__eq__:
        return [field.name for field in fields(kind)]
    return None


def forget_changed() -> None:
    """Forgets all results where a tensor on a GPU has changed by `.data`; that takes one read."""
    pairs: dict[torch.device, list[tuple[Tensor, Tensor]]] = {}
    results = [*_memory.values()]
    for reference, version, copy in (source for result in results for source in result.sources):
        tensor = reference()
        if tensor is None or copy is None or not tensor.is_cuda or version != version_of(tensor):
            continue
        pairs.setdefault(tensor.device, []).append((tensor.detach(), copy))
    for on_device in pairs.values():
        now, then = (
            torch.cat([tensor.flatten() for tensor in tensors])
            for tensors in zip(*on_device, strict=True)
        )
        if not torch.equal(now, then):
            _memory.clear()


@remember
def is_any_nonzero(tensor: Tensor) -> bool:
    """Whether one of the numbers of `tensor` is not 0."""
    return bool((tensor != 0).any())


def constant(numbers: Sequence[float], like: Tensor) -> Tensor:
    """`numbers` as a tensor [N] of the type and on the device of `like`; nobody may change it."""
    return _write(tuple(numbers), like.dtype, like.device)


@functools.lru_cache(maxsize=4096)
def _write(numbers: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(numbers, dtype=dtype, device=device)


_may_read = True


def may_read() -> bool:
    """Whether a computation may depend on numbers that it reads."""
    return _may_read


@contextmanager
def without_reads() -> Iterator[None]:
    """Within it nothing is read: solves make as many iterations as they are told."""
    global _may_read
    _may_read = False
    try:
        yield
    finally:
        _may_read = True
