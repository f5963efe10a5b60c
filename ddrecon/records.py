"""Records whose fields say what they may hold, and what is wrong in one that was made in Python.

The metadata of a field hold limits of its numbers, or the `choices` that it is one of.
"""

import math
import operator
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, field, fields, is_dataclass
from functools import cache
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, Literal, TypedDict, Union, Unpack, get_args, get_origin, get_type_hints

LIMITS: dict[str, tuple[str, Callable[[float, float], bool]]] = {
    "minimum": ("at least", operator.ge),
    "above": ("above", operator.gt),
    "maximum": ("at most", operator.le),
    "below": ("below", operator.lt),
}
"""What a bound in a field's metadata means."""
WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
"""What values of plain types are called."""
Violation = tuple[str, str]
"""The key of a record that breaks a rule, and what is wrong with its value."""
type_hints: Callable[[type], dict[str, Any]] = cache(get_type_hints)


class Limits(TypedDict, total=False):
    """Limits of each number of a field; `minimum` and `maximum` are legal, the others are not.

    Of a vector that `is_nonzero` one entry is not 0. The manual has `expert` fields in a table at
    its end: no scene needs these.
    """

    minimum: float
    above: float
    maximum: float
    below: float
    is_nonzero: bool
    expert: bool


def bounded(default: Any = MISSING, **limits: Unpack[Limits]) -> Any:
    """A number, or numbers, within `limits`; the scene must give it where it has no `default`."""
    return field(default=default, metadata=dict(limits))


def one_of(default: Any, choices: Collection[Any], expert: bool = False) -> Any:
    """One of `choices`, `default` where the scene gives none."""
    return field(default=default, metadata={"choices": tuple(choices), "expert": expert})


def is_required(key: Field[Any]) -> bool:
    """Whether `key` has no default."""
    return key.default is key.default_factory is MISSING


@cache
def alternatives(hint: Any) -> tuple[Any, ...]:
    """The types that `hint` allows."""
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def faults_of(
    record: Any, name: str = "", keys: Collection[str] | None = None
) -> Iterator[Violation]:
    """What is wrong in `record`, a dataclass called `name`, or in its `keys`, and in those within.

    Values are to be of their types and within their limits.
    """
    hints = type_hints(type(record))
    for key in (key for key in fields(record) if keys is None or key.name in keys):
        owner = f"{name}.{key.name}".strip(".")
        yield from _find_faults(owner, getattr(record, key.name), hints[key.name], key.metadata)


def _find_faults(
    name: str, value: Any, hint: Any, limits: Mapping[str, Any]
) -> Iterator[Violation]:
    """What is wrong with `value`, called `name`, by its type `hint` and by `limits`."""
    kind = next((kind for kind in alternatives(hint) if _is_of(value, kind)), None)
    if kind is None:
        words = " or ".join(_describe(kind) for kind in alternatives(hint) if kind is not NoneType)
        is_short = isinstance(value, Real | str | tuple | NoneType)
        yield name, f"expected {words}, found {repr(value) if is_short else type(value).__name__}"
    elif "choices" in limits and value is not None and value not in limits["choices"]:
        yield name, f"expected one of {', '.join(map(str, limits['choices']))}, found {value!r}"
    elif is_dataclass(value):
        yield from faults_of(value, name)
    elif isinstance(value, Real) and not isinstance(value, bool):
        if fault := find_excess(float(value), limits):
            yield name, fault
    elif get_args(kind) and isinstance(value, Mapping):
        for key, entry in value.items():
            yield from _find_faults(f"{name}.{key}", entry, get_args(kind)[1], limits)
    elif get_args(kind) and isinstance(value, Sequence) and not isinstance(value, str):
        for index, entry in enumerate(value):
            key = getattr(entry, "name", index)
            yield from _find_faults(f"{name}.{key}", entry, get_args(kind)[0], limits)


def find_excess(number: float, limits: Mapping[str, Any]) -> str:
    """What is wrong with `number` by `limits`, empty where nothing is."""
    if not math.isfinite(number):
        return f"must be finite, found {number:g}"
    for key, (words, is_within) in LIMITS.items():
        if limits.get(key) is not None and not is_within(number, limits[key]):
            return f"must be {words} {limits[key]:g}, found {number:g}"
    return ""


def _is_of(value: Any, kind: Any) -> bool:
    """Whether `value` is of the type `kind`, whatever is in it."""
    origin, arguments = get_origin(kind) or kind, get_args(kind)
    if origin is Literal:
        return value in arguments
    if origin in (tuple, list):
        is_list = isinstance(value, Sequence) and not isinstance(value, str)
        return is_list and (Ellipsis in arguments or origin is list or len(value) == len(arguments))
    if origin in (int, float):
        number = Real if origin is float else Integral
        return isinstance(value, number) and not isinstance(value, bool)
    return isinstance(value, origin)


def _describe(kind: Any) -> str:
    """What a value of the type `kind` is, in words."""
    if get_origin(kind) is Literal:
        return " or ".join(map(repr, get_args(kind)))
    if get_origin(kind) is tuple:
        return f"{'' if Ellipsis in get_args(kind) else len(get_args(kind))} numbers".strip()
    name = getattr(get_origin(kind) or kind, "__name__", str(kind))
    return WORDS.get(kind, "a tensor" if name == "Tensor" else name)
