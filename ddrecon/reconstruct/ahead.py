"""What is made ready before a process's first iteration."""

from __future__ import annotations

from collections.abc import Callable

from ddrecon.engine import current_engine
from ddrecon.ranks import rank_count


def compile_ahead(computation: Callable[[], object]) -> None:
    """Has the fused kernels of `computation` compiled side by side, where none is loaded yet.

    `computation` is rehearsed: called with kernels that do nothing, on what nobody else reads. Of
    several ranks none does so, as what one of them leaves out the others would wait for.
    """
    if current_engine() == "warp" and rank_count() == 1:
        from ddrecon.kernels.compiling import compile_rehearsed

        compile_rehearsed(computation)
