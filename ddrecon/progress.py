"""How work that takes long shows how far it is: whoever asks for it hands in what shows it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

Progress = Callable[[Sequence[Any], str], Iterable[Any]]
"""`progress(items, what)` gives the `items` one by one, and shows that `what` is being done."""
