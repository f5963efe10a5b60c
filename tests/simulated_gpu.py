"""A processor that stands in for a GPU: its tensors lie elsewhere, and nothing crosses unseen.

What a GPU has is a `Distant` tensor around one of the processor's, of the device `meta`. Operations
on both together fail as on a GPU; those that read numbers, or copy between the two memories, are
seen as such. Kernels, solves and sweeps take a GPU's ways, but for how they cut their items.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any
from unittest.mock import patch

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

wp = pytest.importorskip("warp")

from ddrecon.diffusion.rounds.fused import sweep  # noqa: E402
from ddrecon.kernels import launch  # noqa: E402
from ddrecon.kernels.capture import READS, Watch  # noqa: E402

# The module: the package has a function of its name.
multigrid = importlib.import_module("ddrecon.diffusion.solvers.multigrid")
FAR = torch.device("meta")
INDEXED = "index", "index_put", "index_put_", "_index_put_impl_"


class Distant(Tensor):
    """A tensor on the simulated GPU, whose numbers are those of `near`."""

    near: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, near: Tensor) -> Distant:
        made = Tensor._make_wrapper_subclass(
            cls,
            near.shape,
            strides=near.stride(),
            storage_offset=near.storage_offset(),
            dtype=near.dtype,
            device=FAR,
        )
        made.near = near
        return made

    def __getitem__(self, index: Any) -> Any:
        # torch would make a list a tensor of the device meta, without numbers.
        parts = index if isinstance(index, tuple) else (index,)
        return super().__getitem__(
            tuple(torch.tensor(part) if isinstance(part, list) else part for part in parts)
        )

    @classmethod
    def __torch_dispatch__(
        cls, function: Any, types: Any, arguments: Any = (), options: Any = None
    ) -> Any:
        return _run(function, arguments, options or {})


@dataclass
class Program:
    """Operations and launches in their order, with the memory they work on.

    `described`: each operation or kernel, and sizes.
    """

    steps: list[Callable[[], None]] = field(default_factory=list)
    described: list[tuple[Any, ...]] = field(default_factory=list)
    made: list[Tensor] = field(default_factory=list)

    def again(self) -> None:
        """Does all of it once more, in place."""
        for step in self.steps:
            step()

    def spoil(self) -> None:
        """Makes all numbers NaN that the program is to make."""
        for tensor in self.made:
            if tensor.is_floating_point():
                tensor.fill_(torch.nan)


_program: Program | None = None
"""What is being recorded."""


def record(computation: Callable[[], Any]) -> tuple[Any, Callable[[], None]]:
    """In place of `capture.record_graph`; what is computed on the way is forgotten."""
    global _program
    computation()
    with Watch():
        computation()
        _program = program = Program()
        try:
            made = computation()
        finally:
            _program = None
    program.spoil()
    return made, program.again


def put(value: Any) -> Any:
    """`value`, a tensor or a record with tensors inside, on the simulated GPU."""
    if isinstance(value, Tensor):
        return Distant(value.detach().clone())
    if isinstance(value, dict):
        return {key: put(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(put(one) for one in value)
    if is_dataclass(value) and not isinstance(value, type):
        own = {one.name: getattr(value, one.name) for one in fields(value) if one.init}
        moved = {name: put(one) for name, one in own.items()}
        changed = {name: one for name, one in moved.items() if one is not own[name]}
        return replace(value, **changed) if changed else value
    return value


@contextlib.contextmanager
def simulated_gpu() -> Iterator[None]:
    """There is a GPU, on which tensors are that were `put` there."""
    own_call, own_solve = launch._call, multigrid.solve_by_torch
    processor = wp.get_device("cpu")

    def call(kernel: Any, device: Any, items: int, given: list[Any], _: Any) -> None:
        own_call(kernel, processor, items, given, None)
        if _program is not None:
            # Records are used again with other numbers in them.
            kept = [
                type(one).from_buffer_copy(one) if isinstance(one, ctypes.Structure) else one
                for one in given
            ]
            _program.described.append((kernel.key, items))
            _program.steps.append(lambda: own_call(kernel, processor, items, kept, None))

    def solve(operator: Any, source: Tensor, guess: Any, tolerance: float, _: bool) -> Any:
        return own_solve(operator, source, guess, tolerance, isinstance(source, Distant))

    own_list, own_array, address = Tensor.tolist, wp.from_torch, Tensor.data_ptr
    patches = [
        (launch, "_call", call),
        (launch, "_device", lambda device: processor),
        (multigrid, "current_engine", lambda: "torch"),
        (multigrid, "solve_by_torch", solve),
        (sweep, "sweep_fused", functools.partial(sweep.sweep_fused, by_cells=True)),
        (wp, "from_torch", lambda one, **options: own_array(one.near, **options)),
        (Tensor, "data_ptr", lambda one: address(one.near)),
        (Tensor, "tolist", lambda one: own_list(one.cpu())),
        *((torch, name, _putting(getattr(torch, name))) for name in ("tensor", "as_tensor")),
        (Tensor, "new_tensor", _new_tensor),
    ]
    with contextlib.ExitStack() as stack:
        for owner, name, function in patches:
            stack.enter_context(patch.object(owner, name, function))
        stack.enter_context(_Everywhere())
        yield


class _Everywhere(TorchDispatchMode):
    """Sees operations that only make tensors, too."""

    def __torch_dispatch__(
        self, function: Any, types: Any, arguments: Any = (), options: Any = None
    ) -> Any:
        return _run(function, arguments, options or {})


def _putting(make: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """A function that makes tensors of numbers, and sends them where they are wanted."""

    def made(data: Any, *, device: Any = None, **options: Any) -> Tensor:
        if isinstance(data, Distant) or device is None or torch.device(device) != FAR:
            return make(data, device=device, **options)
        return make(data, **options).to(FAR)

    return made


_own_new_tensor, _own_tensor = Tensor.new_tensor, torch.tensor


def _new_tensor(like: Tensor, data: Any, dtype: torch.dtype | None = None) -> Tensor:
    if not isinstance(like, Distant):
        return _own_new_tensor(like, data, dtype=dtype)
    return _own_tensor(data, dtype=dtype or like.dtype).to(FAR)


def _run(function: Any, arguments: Any, options: dict[str, Any]) -> Any:
    """An operation where its tensors are."""
    name = function._schema.name.removeprefix("aten::")
    given = _tensors((*arguments, *options.values()))
    far = {id(one.near): one for one in given if isinstance(one, Distant)}
    device = torch.device(options.get("device") or (FAR if far else "cpu"))
    if far and name not in ("copy_", "_to_copy", *INDEXED):
        lost = [one for one in given if not isinstance(one, Distant) and one.ndim]
        assert not lost, f"{name}: tensors on two devices"
    near_arguments = [_near(one) for one in arguments]
    near_options = {key: _near(one) for key, one in options.items()}
    out = function(*near_arguments, **near_options)
    if device != FAR or name in READS - {"nonzero", "masked_select"}:
        return out
    if name == "copy_" and not isinstance(arguments[0], Distant):
        return arguments[0]
    if _program is not None:
        _note(function, near_arguments, near_options, out)
    return _there(out, far)


def _there(near: Any, known: dict[int, Distant]) -> Any:
    """What is `near` on the simulated GPU, where some tensors are `known`."""
    if isinstance(near, list | tuple):
        return type(near)(_there(one, known) for one in near)
    if not isinstance(near, Tensor):
        return near
    return known[id(near)] if id(near) in known else Distant(near)


def _tensors(values: Sequence[Any]) -> list[Tensor]:
    """The tensors among `values`, and in lists among them."""
    found = []
    for one in values:
        if isinstance(one, Tensor):
            found.append(one)
        elif isinstance(one, list | tuple):
            found += [each for each in one if isinstance(each, Tensor)]
    return found


def _near(value: Any) -> Any:
    if isinstance(value, Distant):
        return value.near
    if isinstance(value, list | tuple):
        return type(value)(_near(one) for one in value)
    return torch.device("cpu") if isinstance(value, torch.device) else value


def _note(function: Any, arguments: Any, options: Any, out: Any) -> None:
    """Adds an operation to the program that is being recorded."""
    sizes = [one.shape for one in _tensors((*arguments, *options.values()))]
    _program.described.append((function, *sizes))
    marks = [result.alias_info for result in function._schema.returns]
    if any(mark is not None and not mark.is_write for mark in marks):
        return  # it only looks at memory that is there
    if any(mark is not None for mark in marks):
        _program.steps.append(lambda: function(*arguments, **options))
        return
    made = _tensors([out])
    if function._schema.name == "aten::_unsafe_view":
        return
    _program.made.extend(made)

    def do() -> None:
        found = function(*arguments, **options)
        for one, new in zip(made, _tensors([found]), strict=True):
            one.copy_(new)

    _program.steps.append(do)
