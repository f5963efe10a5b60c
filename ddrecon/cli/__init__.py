"""The command line."""

import os
import signal
from contextlib import suppress
from typing import Any

from ddrecon.interrupts import INTERRUPTED, end_at_once, on_interrupt


def main(*arguments: Any, **settings: Any) -> None:
    """The program: `ddrecon.cli.commands.main`, which Ctrl-C ends at every moment."""
    try:
        with on_interrupt(end_at_once):
            from ddrecon.cli.commands import main as commands

            commands(*arguments, **settings)
    except SystemExit as end:
        if end.code == INTERRUPTED:
            os._exit(INTERRUPTED)  # threads that compile kernels are not waited for
        raise
    except OSError as error:
        if error.filename is not None or error.errno is None:
            raise
        # A stream failed, not a file: the rest of its buffer cannot be written at the end either.
        with suppress(OSError):
            os.write(2, f"cannot write: {error.strerror}\n".encode())
        os._exit(3)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done
