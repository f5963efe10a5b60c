"""What each derivative written by hand gains over autograd of the plain formula: time and memory.

    python benchmarks/by_hand.py [--repeats 9] [--only NAME ...]

One thread, float32, three colors; 64 x 96 x 64 cells, or as many nodes of view rays as are marched
at a time. Time is that of forward and backward pass together, and its ratio the median over runs in
turns. Memory is what is saved for the backward pass beside the inputs, counted by saved-tensor
hooks. The plain formulas are those of `tests/plain_formulas.py`.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from pathlib import Path

import torch
from torch import Tensor
from torch.autograd.graph import saved_tensors_hooks

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from plain_formulas import RULES, Function, Shape

CELLS: Shape = (64, 3, 96, 64)
RAYS: Shape = (66, 3, 62, 64)
ALONG_RAYS = ("decayed_sum", "evaluate_positive")


def differentiate(function: Function, inputs: tuple[Tensor, ...]) -> tuple[float, int]:
    """Seconds of a forward and a backward pass, and the bytes saved between them."""
    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    known = {leaf.untyped_storage().data_ptr() for leaf in leaves}
    saved: dict[int, int] = {}

    def count(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in known:
            saved[storage.data_ptr()] = storage.nbytes()
        return tensor

    start = time.perf_counter()
    with saved_tensors_hooks(count, lambda tensor: tensor):
        result = function(*leaves)
    outputs = result if isinstance(result, tuple) else (result,)
    torch.autograd.backward(outputs, [torch.ones_like(output) for output in outputs])
    return time.perf_counter() - start, sum(saved.values())


def main() -> None:
    """Prints a table in Markdown."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--only", nargs="*", default=list(RULES))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print("| function | by hand [ms] | autograd / by hand | by hand [MiB] | autograd [MiB] |")
    print("|---|---|---|---|---|")
    for name in arguments.only:
        rule = RULES[name]
        inputs = rule.inputs(RAYS if name in ALONG_RAYS else CELLS, torch.float32)
        differentiate(rule.by_hand, inputs), differentiate(rule.plain, inputs)
        runs = [
            (differentiate(rule.by_hand, inputs), differentiate(rule.plain, inputs))
            for _ in range(arguments.repeats)
        ]
        seconds = statistics.median(hand[0] for hand, _ in runs)
        ratio = statistics.median(plain[0] / hand[0] for hand, plain in runs)
        kept, kept_plain = runs[0][0][1], runs[0][1][1]
        print(
            f"| `{name}` | {1e3 * seconds:.1f} | {ratio:.2f} "
            f"| {kept / 2**20:.1f} | {kept_plain / 2**20:.1f} |"
        )


if __name__ == "__main__":
    main()
