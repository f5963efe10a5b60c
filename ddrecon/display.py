"""How records show themselves: briefly as text, and in a notebook as what a room above draws.

The package itself puts that there (`Displayed._repr_html_`), so that no record knows of pages.
"""

from __future__ import annotations

import reprlib
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from torch import Tensor

SMALL = 4
"""Tensors of so many numbers are shown by these, larger ones by their range."""


class Displayed:
    """A record of few words, which notebooks show as the HTML that `_repr_html_` makes."""

    _repr_html_: ClassVar[Callable[[Any], str]]

    def __repr__(self) -> str:
        """What differs from its default, a line each; of tensors shape, device and range."""
        lines = "".join(f"  {entry},\n" for entry in _Brief().parts_of(self, 6))
        return f"{type(self).__name__}(\n{lines})"


class _Brief(reprlib.Repr):
    """Lists and mappings by their first two entries, records by what differs from its default."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlist, self.maxdict, self.maxstring = 2, 2, 100

    def parts_of(self, record: Any, level: int) -> list[str]:
        entries = []
        for field in fields(record):
            value, default = getattr(record, field.name), field.default
            if field.default_factory is not MISSING:
                default = field.default_factory()
            if type(value) is not type(default) or value != default:
                entries.append(f"{field.name}={self.repr1(value, level - 1)}")
        return entries

    def repr_instance(self, x: Any, level: int) -> str:
        if is_dataclass(x):
            return f"{type(x).__name__}({', '.join(self.parts_of(x, level))})"
        return repr(x)

    def repr_Tensor(self, x: Tensor, level: int) -> str:
        value = x.detach()
        if value.numel() <= SMALL:
            numbers = ", ".join(f"{number:.4g}" for number in value.flatten().tolist())
            return f"[{numbers}]" if value.ndim else numbers
        kind = str(value.dtype).removeprefix("torch.")
        span = f"{float(value.min()):.4g} to {float(value.max()):.4g}"
        return f"<{list(value.shape)} {kind} on {value.device}, {span}>"

    repr_Parameter = repr_Tensor
