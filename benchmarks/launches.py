"""What an iteration of a reconstruction asks of the machine: calls, launches, waits.

    python benchmarks/launches.py [--plume] [--config NAME] [--modules] [--as-a-gpu]

Prints a table in Markdown: of each engine without and with a transport round; with `--modules`
another, where in ddrecon the calls come from. The iteration is one of `configs/plume.yaml` at full
resolution; `--plume` takes the gray one of `bench`, in one view of 512 x 512 pixels, and `--config`
another one of `configs` as it is. `--as-a-gpu` makes a GPU's choices on a processor
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
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import Any
from unittest.mock import patch

import torch
from speed import start_run
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import ddrecon
from ddrecon.bench import plume_scene
from ddrecon.engine import ENGINES, use_engine
from ddrecon.io.volumes.table import read_field
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene

ROOT = Path(__file__).parents[1]
PACKAGE = Path(ddrecon.__file__).parent
HELPERS = "kernels", "numerics"
"""Rooms whose calls count for whoever asked."""
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
WARM_UP = 2
"""Iterations before the one that is counted."""
FEWEST = 10
"""Modules with fewer calls and launches than this, and no reads, stand in one line."""


@dataclass
class Counts:
    """How many of each kind come from each module: `call`, `launch`, `read`, `write`."""

    of: Counter[tuple[str, str]] = field(default_factory=Counter)

    def add(self, kind: str) -> None:
        self.of[kind, origin()] += 1

    def total(self, *kinds: str, module: str | None = None) -> int:
        return sum(
            count
            for (kind, place), count in self.of.items()
            if kind in kinds and module in (None, place)
        )


class Operations(TorchDispatchMode):
    """Counts operations of torch, and those of them that a processor waits for."""

    def __init__(self, counts: Counts):
        super().__init__()
        self.counts = counts

    def __torch_dispatch__(
        self, function: Any, types: Any, arguments: Any = (), options: Any = None
    ) -> Any:
        if is_read(function, arguments):
            self.counts.add("read")
        if not is_free(function):
            self.counts.add("call")
        return function(*arguments, **(options or {}))


@contextmanager
def conversions_counted(counts: Counts) -> Iterator[None]:
    """Counts tensors that become Python's numbers, and numbers that become tensors.

    In backward passes as well, where torch's modes do not see them.
    """

    def counted(function: Callable[..., Any], kind: str) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            if kind == "read" or not isinstance(arguments[-1], Tensor):
                counts.add(kind)
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


def origin() -> str:
    """The module of ddrecon that is at work; in a backward pass that whose derivative it is."""
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        # Derivatives that torch takes itself remember where their function was called.
        if frame.f_code.co_name == "_engine_run_backward":
            node = torch._C._current_autograd_node()
            lines = node.metadata.get("traceback_", []) if node is not None else []
            files = [line.split('"')[1] for line in reversed(lines) if line.count('"') > 1]
            return next(filter(None, map(module_of, files)), "torch")
        if name := module_of(frame.f_code.co_filename):
            return name
        frame = frame.f_back
    return "torch"


def module_of(file: str) -> str | None:
    """A file's place in ddrecon; None for one elsewhere, and for helpers."""
    if not file.startswith(f"{PACKAGE}/"):
        return None
    name = file.removeprefix(f"{PACKAGE}/")
    return None if name.split("/")[0] in HELPERS else name


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
            counts.add("launch")
        return launch(*arguments, **options)

    def counted_again(*arguments: Any, **options: Any) -> Any:
        counts.add("launch")
        return launch_again(*arguments, **options)

    with patch.object(wp, "launch", counted), patch.object(wp.Launch, "launch", counted_again):
        yield


def begin_plume(cells: int, pixels: int, rounds: int, device: str) -> Reconstruction:
    """The gray plume of `bench`, from half its density; without `rounds` it is the paper's case."""
    scene = plume_scene(cells, pixels, torch.float32, torch.device(device))
    # A medium that is sought is received in whole cells, whatever this one deserves.
    settings = replace(scene.diffusion, transport_rounds=rounds, receive=1)
    return start_run(replace(scene, diffusion=settings))


def load_config(name: str, rounds: int, device: str) -> Scene:
    """The scene of a file in `configs`."""
    overrides = [f"diffusion.transport_rounds={rounds}"]
    return load_scene(ROOT / "configs" / f"{name}.yaml", overrides=overrides, device=device)


def load(views: int, rounds: int, device: str) -> Scene:
    """The plume at full resolution, from half its density."""
    scene = load_config("plume", rounds, device)
    density = torch.tensor(read_field(ROOT / "data" / "plume" / "density.npz", "density").values)
    start = 0.5 * density.to(scene.volume.density)
    seen = [view for view in scene.views if not view.is_test][:views]
    return replace(scene, views=seen, starts={"density": start})


def count(run: Reconstruction) -> Counts:
    """What one iteration asks, once all is warm."""
    counts = Counts()
    for _ in range(WARM_UP):
        run.step()
    remembered = torch.autograd.set_detect_anomaly(True, check_nan=False)
    with remembered, launches_counted(counts), conversions_counted(counts), Operations(counts):
        run.step()
    return counts


def print_totals(found: dict[tuple[str, int], Counts]) -> None:
    print("| engine | transport rounds | calls | launches | both | reads | writes |")
    print("|---|---|---|---|---|---|---|")
    for (engine, rounds), counts in found.items():
        kinds = ("call",), ("launch",), ("call", "launch"), ("read",), ("write",)
        numbers = [str(counts.total(*kind)) for kind in kinds]
        print(f"| {engine} | {rounds} | {' | '.join(numbers)} |")


def print_modules(found: dict[tuple[str, int], Counts]) -> None:
    last = list(found.values())[-1]
    modules = {module for counts in found.values() for _, module in counts.of}

    def weight(module: str) -> int:
        return last.total("call", "launch", module=module)

    def cell(counts: Counts, chosen: Sequence[str]) -> str:
        calls, reads = (
            sum(counts.total(*kinds, module=module) for module in chosen)
            for kinds in (("call", "launch"), ("read",))
        )
        return f"{calls}, {reads}" if reads else f"{calls}"

    few = [m for m in modules if weight(m) < FEWEST and not last.total("read", module=m)]
    rows = [(f"`{module}`", [module]) for module in sorted(modules - set(few), key=weight)[::-1]]
    print(f"\n| calls and launches, reads | {' | '.join(f'{e}, {r}' for e, r in found)} |")
    print("|---|" + "---|" * len(found))
    for name, chosen in [*rows, ("others", few)]:
        print(f"| {name} | {' | '.join(cell(counts, chosen) for counts in found.values())} |")


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--engines", nargs="+", default=ENGINES, choices=ENGINES)
    parser.add_argument("--rounds", nargs="+", type=int, default=(0, 1))
    parser.add_argument("--plume", action="store_true")
    parser.add_argument("--config")
    parser.add_argument("--modules", action="store_true")
    parser.add_argument("--as-a-gpu", action="store_true")
    options = parser.parse_args()
    if options.as_a_gpu:
        sys.path.append(str(ROOT / "tests"))
        from as_on_a_gpu import as_on_a_gpu
    choices = as_on_a_gpu if options.as_a_gpu else nullcontext
    torch.set_num_threads(1)  # so that a kernel is one launch, as on a GPU
    found = {}
    for engine in options.engines:
        use_engine(engine)
        for rounds in options.rounds:
            with choices():
                if options.plume:
                    run = begin_plume(64, 512, rounds, options.device)
                elif options.config:
                    run = Reconstruction(load_config(options.config, rounds, options.device))
                else:
                    run = Reconstruction(load(options.views, rounds, options.device))
                found[engine, rounds] = count(run)
    print_totals(found)
    if options.modules:
        print_modules(found)


if __name__ == "__main__":
    main()
