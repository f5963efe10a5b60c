"""Which kernels run: PyTorch's, or fused ones in NVIDIA Warp.

An engine is an implementation of the inner loops. `torch` is the readable definition and has them
all; `warp` (package warp-lang, the extra `fast`) fuses a loop into one kernel. Both compute the
same formulas, so their numbers agree to rounding. Torch's are, with either engine: point lights but
for the mass on the way to them, the scattering of skies towards a camera, tangents in forward mode
by where lights are, the model `flux_limited`, the scheme `printed`, and solvers other than
`multigrid`. So is of light and of rounds what has the phase function in it, where that differs from
cell to cell. So are, on GPUs whose ranks share out cells, the sweeps of rounds.
"""

from __future__ import annotations

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
VARIABLE = "DDRECON_ENGINE"
"""The environment variable that chooses where `use_engine` was not called; `auto` without it."""
LOG = "ddrecon.engine"
"""The logger that is told when kernels are compiled, which happens once."""

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
        name = os.environ.get(VARIABLE) or "auto"
        _engine = _resolve(name, f"{VARIABLE}={name}")
    return _engine


def engine_of_parts(in_torch: Collection[str] = ()) -> dict[str, str]:
    """The engine that runs each part of the renderer: the current one, but for those `in_torch`."""
    engine = current_engine()
    return {part: "torch" if part in in_torch else engine for part in PARTS}


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
    return "warp" if is_installed else "torch"
