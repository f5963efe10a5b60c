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
from pathlib import Path
from tempfile import TemporaryFile

from ddrecon.errors import MissingExtraError, UsageError
from ddrecon.extras import advice

ENGINES = ("torch", "warp")
"""The engines there are."""
CHOICES = ("auto", *ENGINES)
"""What can be asked for; `auto` is warp where it is installed, else torch."""
PARTS = "view rays", "light", "diffusion", "transport rounds"
"""The parts of the renderer, which every engine has."""
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
    if name not in CHOICES:
        raise UsageError(f"{asked}: no such engine; known: {', '.join(CHOICES)}")
    if name == "torch":
        return name
    # Looked for, not imported: that takes a third of a second.
    is_installed = find_spec("warp") is not None
    if name == "warp" and not is_installed:
        raise MissingExtraError(f"{asked} {advice('warp')}")
    if is_installed:
        return _keep_kernels(name, asked)
    missing = 'engine torch: pip install "ddrecon[fast]" brings warp, which is many times as fast'
    logging.getLogger(LOG).info(missing)
    return "torch"


def _keep_kernels(name: str, asked: str) -> str:
    """`warp`, once there is a folder for its kernels; `torch` where there is none, with `auto`.

    Where the usual one cannot be written, as in containers, `auto` takes a temporary one. Raises
    UsageError for `warp` there.
    """
    usual = os.environ.get(CACHE) or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    if os.name != "posix" or _is_writable(Path(usual)):
        return "warp"
    advice = f"set {CACHE} to a folder that can be written"
    lost = f"kernels cannot be kept in {usual}"
    if name == "warp":
        raise UsageError(f"{asked}: {lost}; {advice}")
    folder = Path(os.environ.get("TMPDIR") or "/tmp", f"ddrecon-{os.getuid()}")
    # What others put there would be run as kernels.
    if _is_writable(folder) and folder.lstat().st_uid == os.getuid():
        os.environ[CACHE] = str(folder)
        name, instead = "warp", f", but in {folder}"
    else:
        name, instead = "torch", ""
    logging.getLogger(LOG).info(f"engine {name}: {lost}{instead}; {advice}")
    return name


def _is_writable(folder: Path) -> bool:
    """Whether files can be written to `folder`, which is made."""
    try:
        place = folder.expanduser()
        place.parent.mkdir(parents=True, exist_ok=True)
        place.mkdir(0o700, exist_ok=True)
        with TemporaryFile(dir=place):
            return True
    except (OSError, RuntimeError):  # the latter where nobody knows a home
        return False
