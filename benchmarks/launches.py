"""What an iteration of a reconstruction asks of the machine: calls, launches, waits.

    python benchmarks/launches.py [CASE]... [--as-a-gpu] [--engine warp] [--device cpu]

Prints a table in Markdown, a row for each case. `--as-a-gpu` makes a GPU's choices on a processor
(`tests/as_on_a_gpu.py`), which takes some minutes.

A call is an operation of torch, which on a GPU costs at least 5 microseconds; not counted are views
of tensors, memory without numbers yet, and numbers that are read. A launch is that of a fused
kernel. A read hands a tensor's numbers, or a size that depends on them, to Python: there the
processor waits for a GPU. A write makes a tensor of Python's numbers, for which it waits as well.
All are counted alike on a machine without a GPU.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
from figures import ROOT, print_header, print_row
from runs import start_config, start_paper_case, start_plume
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from ddrecon.engine import ENGINES, use_engine
from ddrecon.reconstruct.loop import Reconstruction

CONVERSIONS = (
    *((Tensor, name, "read") for name in ("tolist", "numpy", "__array__")),
    *((torch, name, "write") for name in ("tensor", "as_tensor")),
    (Tensor, "new_tensor", "write"),
)
"""The same by functions that reach no operation of torch."""
READS = {"_local_scalar_dense", "nonzero", "masked_select", "equal", "_unique2", "unique_dim"}
"""Operations of torch whose result, or its size, a processor waits for."""
INDEXED = "index", "index_put", "index_put_", "_index_put_impl_"
"""Operations that take indices, or masks, whose sum is a size."""
CASES: dict[str, tuple[str, Callable[[str], Reconstruction]]] = {
    "paper": (
        "64 x 96 x 64, 512^2, no round: the paper's case",
        lambda device: start_paper_case(64, 512, 0, device),
    ),
    "round": ("the same with a round", lambda device: start_paper_case(64, 512, 1, device)),
    "plume": ("`plume.yaml`, three views, a round", start_plume),
    "fire": ("`fire.yaml`, eight views", partial(start_config, "fire")),
    "capture": (
        "`capture.yaml`, four views, whose cameras are sought",
        partial(start_config, "capture"),
    ),
}
"""What is counted: the paper's own case, and configs."""


Counts = Counter[str]
"""How many there are of each kind: `call`, `launch`, `read`, `write`."""


class Operations(TorchDispatchMode):
    """Counts operations of torch, and those of them that a processor waits for."""

    def __init__(self, counts: Counts):
        super().__init__()
        self.counts = counts

    def __torch_dispatch__(
        self, function: Any, types: Any, arguments: Any = (), options: Any = None
    ) -> Any:
        if is_read(function, arguments):
            self.counts["read"] += 1
        if not is_free(function):
            self.counts["call"] += 1
        return function(*arguments, **(options or {}))


@contextmanager
def conversions_counted(counts: Counts) -> Iterator[None]:
    """Counts tensors that become Python's numbers, and numbers that become tensors.

    In backward passes as well, where torch's modes do not see them.
    """

    def counted(function: Callable[..., Any], kind: str) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            if kind == "read" or not isinstance(arguments[-1], Tensor):
                counts[kind] += 1
            return function(*arguments, **options)

        return call

    with ExitStack() as stack:
        for owner, name, kind in CONVERSIONS:
            function = counted(getattr(owner, name), kind)
            stack.enter_context(patch.object(owner, name, function))
        yield


def is_free(function: Any) -> bool:
    """Whether an operation only looks at memory, or for some: a GPU does nothing for it."""
    marks = [result.alias_info for result in function._schema.returns]
    if any(mark is not None and not mark.is_write for mark in marks):
        return True
    names = ("empty", "new_empty", "_unsafe_view", "_local_scalar_dense")
    return function._schema.name.removeprefix("aten::").startswith(names)


def is_read(function: Any, arguments: Sequence[Any]) -> bool:
    """Whether an operation's result, or its size, is needed by the processor."""
    name = function._schema.name.removeprefix("aten::")
    if name in INDEXED:
        masks = (torch.bool, torch.uint8)
        return any(isinstance(part, Tensor) and part.dtype in masks for part in arguments[1])
    return name in READS


@contextmanager
def launches_counted(counts: Counts) -> Iterator[None]:
    """Counts launches of fused kernels, where there are any."""
    try:
        import warp as wp
    except ImportError:
        yield
        return
    launch, launch_again = wp.launch, wp.Launch.launch

    def counted(*arguments: Any, **options: Any) -> Any:
        if not options.get("record_cmd"):
            counts["launch"] += 1
        return launch(*arguments, **options)

    def counted_again(*arguments: Any, **options: Any) -> Any:
        counts["launch"] += 1
        return launch_again(*arguments, **options)

    with patch.object(wp, "launch", counted), patch.object(wp.Launch, "launch", counted_again):
        yield


def count(run: Reconstruction) -> Counts:
    """What the third iteration asks, when all is warm."""
    counts = Counts()
    for _ in range(2):
        run.step()
    with launches_counted(counts), conversions_counted(counts), Operations(counts):
        run.step()
    return counts


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", choices=[[], *CASES], metavar="CASE")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--engine", default="warp", choices=ENGINES)
    parser.add_argument("--as-a-gpu", action="store_true")
    options = parser.parse_args()
    choices = nullcontext
    if options.as_a_gpu:
        sys.path.append(str(ROOT / "tests"))
        from as_on_a_gpu import as_on_a_gpu as choices
    torch.set_num_threads(1)  # so that a kernel is one launch, as on a GPU
    use_engine(options.engine)
    print_header("case", "calls", "launches", "both", "reads", "writes")
    for name in options.cases or CASES:
        what, begin = CASES[name]
        with choices():
            counts = count(begin(options.device))
        calls, launches = counts["call"], counts["launch"]
        numbers = calls, launches, calls + launches, counts["read"], counts["write"]
        print_row(what, *(f"{number:,}" for number in numbers))


if __name__ == "__main__":
    main()
