"""Which kernels run: PyTorch's, or fused ones in NVIDIA Warp.

`torch` is the readable definition of all inner loops; `warp` (package warp-lang, the extra `fast`)
fuses a loop into one kernel of the same formulas, so numbers agree to rounding.
`numerics.autodiff.is_fused` says where kernels run.
"""

import logging
import os
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryFile

from ddrecon.errors import MissingExtraError, UsageError
from ddrecon.extras import advice

ENGINES = ("torch", "warp")
CHOICES = ("auto", *ENGINES)
"""What can be asked for; `auto` is warp where it is installed, else torch."""
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


def engine_versions() -> dict[str, str]:
    """The current `engine`, and the version of `warp-lang` where that is warp."""
    from importlib.metadata import version  # imported late, so that help answers at once

    engine = current_engine()
    return {"engine": engine} | ({"warp-lang": version("warp-lang")} if engine == "warp" else {})


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
        raise MissingExtraError(asked, advice("warp"))
    missing = 'engine torch: pip install "ddrecon[fast]" brings warp, which is many times as fast'
    logging.getLogger(LOG).info(missing)
    return "torch"


def _place_kernels(name: str, asked: str) -> str:
    """`warp`, once there is a folder for its kernels.

    Where the usual one cannot be written, as in containers, `auto` takes a temporary one, or else
    `torch`, and `warp` raises UsageError.
    """
    usual = os.environ.get(CACHE) or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    if os.name != "posix" or _is_writable(Path(usual)):
        return "warp"
    problem, remedy = f"kernels cannot be kept in {usual}", f"set {CACHE} to a folder to write to"
    if name == "warp":
        raise UsageError(f"{asked}: {problem}; {remedy}")
    folder = Path(os.environ.get("TMPDIR") or "/tmp", f"ddrecon-{os.getuid()}")
    # What others put there would be run as kernels.
    if _is_writable(folder) and folder.lstat().st_uid == os.getuid():
        os.environ[CACHE], engine, problem = str(folder), "warp", f"{problem}, but in {folder}"
    else:
        engine = "torch"
    logging.getLogger(LOG).info(f"engine {engine}: {problem}; {remedy}")
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
