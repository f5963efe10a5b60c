"""How records show themselves: briefly as text, and in a notebook as what a room above draws.

The package itself puts that there (`Displayed._repr_html_`), so that no record knows of pages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from torch import Tensor

FIRST = 2
"""Entries of a list or mapping that are shown."""
SMALL = 4
"""Tensors of so many numbers are shown by these, larger ones by their range."""


class Displayed:
    """A record of few words, which notebooks show as the HTML that `_repr_html_` makes."""

    _repr_html_: ClassVar[Callable[[Any], str]]

    def __repr__(self) -> str:
        """What differs from its default, a line each; of tensors shape, device and range."""
        lines = "".join(f"  {part},\n" for part in _parts(self))
        return f"{type(self).__name__}(\n{lines})"


def _parts(record: Any) -> list[str]:
    pairs = [(field, getattr(record, field.name)) for field in fields(record)]
    return [f"{field.name}={_brief(value)}" for field, value in pairs if _is_told(field, value)]


def _is_told(field: Field[Any], value: Any) -> bool:
    """Whether `value` is another than the default of `field`."""
    default = field.default
    if field.default_factory is not MISSING:
        default = field.default_factory()
    return type(value) is not type(default) or value != default


def _brief(value: Any) -> str:
    from torch import Tensor

    if isinstance(value, Tensor):
        return _brief_tensor(value.detach())
    if isinstance(value, list):
        return f"[{_brief_entries(map(_brief, value), len(value))}]"
    if isinstance(value, Mapping):
        entries = (f"{key}: {_brief(entry)}" for key, entry in value.items())
        return f"{{{_brief_entries(entries, len(value))}}}"
    if is_dataclass(value):
        return f"{type(value).__name__}({', '.join(_parts(value))})"
    return repr(value)


def _brief_entries(entries: Iterable[str], count: int) -> str:
    more = [f"... {count} in all"] if count > FIRST else []
    return ", ".join([*islice(entries, FIRST), *more])


def _brief_tensor(value: Tensor) -> str:
    if value.numel() <= SMALL:
        numbers = ", ".join(f"{number:.4g}" for number in value.flatten().tolist())
        return f"[{numbers}]" if value.ndim else numbers
    kind = str(value.dtype).removeprefix("torch.")
    span = f"{float(value.min()):.4g} to {float(value.max()):.4g}"
    return f"<{list(value.shape)} {kind} on {value.device}, {span}>"
