"""The command line."""

import os
from signal import SIG_IGN
from typing import Any

from ddrecon.interrupts import INTERRUPTED, end_at_once, handle_interrupts


def main(*arguments: Any, **settings: Any) -> None:
    """The program: `ddrecon.cli.commands.main`, which Ctrl-C ends at every moment."""
    handle_interrupts(end_at_once)
    try:
        from ddrecon.cli.commands import main as commands

        commands(*arguments, **settings)
    except SystemExit as end:
        if end.code == INTERRUPTED:
            os._exit(INTERRUPTED)  # threads that compile kernels are not waited for
        raise
    finally:
        handle_interrupts(SIG_IGN)  # all is done
