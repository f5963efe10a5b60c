"""Which kernels run: PyTorch's, or fused ones in NVIDIA Warp.

An engine is an implementation of the inner loops. `torch` is the readable definition and has them
all; `warp` (package warp-lang, the extra `fast`) fuses a loop into one kernel. Both compute the
same formulas, so their numbers agree to rounding. What is torch's with either engine is what
`terms.parts_in_torch` finds in a scene, and tangents in forward mode by where lights are.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Collection, Mapping
from importlib.util import find_spec

from ddrecon.errors import MissingExtraError, UsageError
from ddrecon.extras import advice

ENGINES = ("torch", "warp")
"""The engines there are."""
CHOICES = ("auto", *ENGINES)
"""What can be asked for; `auto` is warp where it is installed, else torch."""
PARTS = "view rays", "light", "diffusion", "transport rounds"
"""The parts of the renderer, which every engine has."""
LOG = "ddrecon.engine"
"""The logger that is told when kernels are compiled, which happens once, or warp is missing."""

_engine: str | None = None
"""The engine of this process, once it is known."""


def use_engine(name: str) -> None:
    """Chooses the engine of this process: `auto`, `torch` or `warp`.

    `auto` takes warp where it is installed, else torch. Raises MissingExtraError for `warp` where
    it is not installed; UsageError for another name.
    """
    global _engine
    _engine = _resolve(name, f"engine {name}")


def current_engine() -> str:
    """The engine of this process, `torch` or `warp`.

    Where `use_engine` was not called, the environment variable DDRECON_ENGINE chooses it. Raises
    what `use_engine` raises.
    """
    global _engine
    if _engine is None:
        name = os.environ.get("DDRECON_ENGINE") or "auto"
        _engine = _resolve(name, f"DDRECON_ENGINE={name}")
    return _engine


def engine_of_parts(in_torch: Collection[str] = ()) -> dict[str, str]:
    """The engine that runs each part of the renderer: the current one, but for those `in_torch`.

    These may be other parts than `PARTS`, within them.
    """
    return dict.fromkeys(PARTS, current_engine()) | dict.fromkeys(in_torch, "torch")


def has_kernels(part: str, is_on_gpu: bool) -> bool:
    """Whether warp has kernels for `part` on such a device.

    Multigrid and sweeps go through rows, on a processor.
    """
    return not (is_on_gpu and part in ("diffusion", "transport rounds"))


def name_engines(engines: Mapping[str, str]) -> str:
    """In words, the `engines` of parts: with warp what it runs and what it leaves to torch."""
    fused = [part for part, engine in engines.items() if engine == "warp"]
    others = [part for part, engine in engines.items() if engine == "torch"]
    if not fused:
        return "torch"
    rest = f"; {' and '.join(others)} in torch" if others else ""
    return f"warp ({', '.join(fused)}){rest}"


def engine_versions() -> dict[str, str]:
    """The current `engine`, and the version of `warp-lang` where that is warp."""
    from importlib.metadata import version  # here, so that help answers at once

    if current_engine() == "torch":
        return {"engine": "torch"}
    return {"engine": "warp", "warp-lang": version("warp-lang")}


def _resolve(name: str, asked: str) -> str:
    """The engine that `name` stands for; `asked` begins the message of an error."""
    if name == "warp-graph":
        raise UsageError(f"{asked}: CUDA graphs are no longer there; take warp")
    if name not in CHOICES:
        raise UsageError(f"{asked}: no such engine; known: {', '.join(CHOICES)}")
    if name == "torch":
        return name
    # Looked for, not imported: that takes a third of a second.
    is_installed = find_spec("warp") is not None
    if name == "warp" and not is_installed:
        raise MissingExtraError(f"{asked} {advice('warp')}")
    if is_installed:
        return "warp"
    missing = 'engine torch: pip install "ddrecon[fast]" brings warp, which is many times as fast'
    logging.getLogger(LOG).info(missing)
    return "torch"
