"""Which kernels run: PyTorch's, or fused ones in NVIDIA Warp.

An engine is an implementation of the inner loops. `torch` is the readable definition and has them
all; `warp` (package warp-lang, the extra `fast`) fuses a loop into one kernel. Both compute the
same formulas, so their numbers agree to rounding. `TORCH_ALONE` is the one table of what warp has
not; besides, warp has no tangents by some tensors (`numerics.autodiff.is_fused`).
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryFile

from ddrecon.errors import MissingExtraError, UsageError
from ddrecon.extras import advice

ENGINES = ("torch", "warp")
CHOICES = ("auto", *ENGINES)
"""What can be asked for; `auto` is warp where it is installed, else torch."""
TORCH_ALONE: dict[str, frozenset[str]] = {
    "view rays": frozenset(),
    "light": frozenset(),
    "diffusion": frozenset({"printed", "flux_limited"}),
    "transport rounds": frozenset(),
}
"""Each part of the renderer, and the traits of a scene with any of which torch runs it."""
CACHE = "WARP_CACHE_PATH"
"""The environment variable that names the folder where Warp keeps kernels."""
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


def has_kernels(part: str, **traits: bool) -> bool:
    """Whether `part`, a key of `TORCH_ALONE`, runs as kernels of warp with these `traits`."""
    is_left = any(is_so and trait in TORCH_ALONE[part] for trait, is_so in traits.items())
    return not is_left and current_engine() == "warp"


def engine_of_parts(**traits: bool) -> dict[str, str]:
    """The engine that runs each part of the renderer for a scene with these `traits`."""
    return {part: "warp" if has_kernels(part, **traits) else "torch" for part in TORCH_ALONE}


def name_engines(engines: Mapping[str, str]) -> str:
    """The `engines` of parts in words: with warp what it runs and what it leaves to torch."""
    fused = [part for part, engine in engines.items() if engine == "warp"]
    others = [part for part, engine in engines.items() if engine == "torch"]
    if not fused:
        return "torch"
    rest = f"; {' and '.join(others)} in torch" if others else ""
    return f"warp ({', '.join(fused)}){rest}"


def engine_versions() -> dict[str, str]:
    """The current `engine`, and the version of `warp-lang` where that is warp."""
    from importlib.metadata import version  # imported late, so that help answers at once

    is_torch = current_engine() == "torch"
    return (
        {"engine": "torch"} if is_torch else {"engine": "warp", "warp-lang": version("warp-lang")}
    )


def _resolve(name: str, asked: str) -> str:
    """The engine that `name` stands for; `asked` begins the message of an error."""
    if name not in CHOICES:
        raise UsageError(f"{asked}: no such engine; known: {', '.join(CHOICES)}")
    if name == "torch":
        return name
    # Looked for, not imported: that takes a third of a second.
    if find_spec("warp") is not None:
        return _place_kernels(name, asked)
    if name == "warp":
        raise MissingExtraError(f"{asked} {advice('warp')}")
    missing = 'engine torch: pip install "ddrecon[fast]" brings warp, which is many times as fast'
    logging.getLogger(LOG).info(missing)
    return "torch"


def _place_kernels(name: str, asked: str) -> str:
    """`warp`, once there is a folder for its kernels; `torch` where there is none, with `auto`.

    Where the usual one cannot be written, as in containers, `auto` takes a temporary one. Raises
    UsageError for `warp` there.
    """
    usual = os.environ.get(CACHE) or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    if os.name != "posix" or _is_writable(Path(usual)):
        return "warp"
    lost, mend = (
        f"kernels cannot be kept in {usual}",
        f"set {CACHE} to a folder that can be written",
    )
    if name == "warp":
        raise UsageError(f"{asked}: {lost}; {mend}")
    folder = Path(os.environ.get("TMPDIR") or "/tmp", f"ddrecon-{os.getuid()}")
    # What others put there would be run as kernels.
    is_own = _is_writable(folder) and folder.lstat().st_uid == os.getuid()
    engine, instead = ("warp", f", but in {folder}") if is_own else ("torch", "")
    if is_own:
        os.environ[CACHE] = str(folder)
    logging.getLogger(LOG).info(f"engine {engine}: {lost}{instead}; {mend}")
    return engine


def _is_writable(path: Path) -> bool:
    """Whether files can be written to the folder `path`, which is made."""
    try:
        folder = path.expanduser()
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(0o700, exist_ok=True)
        with TemporaryFile(dir=folder):
            return True
    except (OSError, RuntimeError):  # the latter where nobody knows a home
        return False
