"""The loss log for TensorBoard, an extra."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ddrecon.extras import load_extra
from ddrecon.reconstruct.log import Row

FOLDER = "tensorboard"
"""Where a run's folder keeps its events."""


def require_tensorboard() -> None:
    """Raises MissingExtraError where TensorBoard is not installed."""
    load_extra("tensorboard", "--tensorboard")


class EventLog:
    """Every number of the loss log as a scalar, named as its column; `writer` is TensorBoard's."""

    def __init__(self, writer: Any):
        self.writer = writer

    def log(self, row: Row) -> None:
        """Adds one row."""
        for name, value in vars(row).items():
            if value is not None and name != "iteration":
                self.writer.add_scalar(name, value, row.iteration)


@contextmanager
def event_log(folder: Path, made: int) -> Iterator[EventLog]:
    """A log of events in the run's `folder`.

    Those after iteration `made`, from which a resumed run goes on, are no longer shown.
    """
    from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(str(folder / FOLDER), purge_step=made + 1)
    try:
        yield EventLog(writer)
    finally:
        writer.close()
