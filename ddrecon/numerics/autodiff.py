"""Automatic differentiation: is a number varied, what to keep, what to recompute.

Every name of torch that is private, or not documented, stands in this file.
"""

import functools
import inspect
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields, is_dataclass
from types import CellType, FunctionType, MethodType
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.autograd.graph import saved_tensors_hooks

from ddrecon.engine import current_engine, use_engine

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])


def is_varied(tensor: Tensor) -> bool:
    """Whether a derivative by `tensor`, or what it was computed from, is taken in either mode."""
    return tensor.requires_grad or forward_ad.unpack_dual(tensor).tangent is not None


def is_forward() -> bool:
    """Whether forward mode, or one of the transforms of `torch.func`, is on."""
    return forward_ad._current_level >= 0 or torch._C._are_functorch_transforms_active()


def is_steady(*tensors: Tensor) -> bool:
    """Whether what is made of `tensors` has no derivatives, and may be kept for later."""
    return not (
        any(tensor.requires_grad or tensor.is_inference() for tensor in tensors)
        or torch._C._are_functorch_transforms_active()
        or (is_forward() and any(map(is_varied, tensors)))
    )


def require_plain_autograd() -> None:
    """Raises NotImplementedError within those transforms of `torch.func` that light has not."""
    stack = torch._C._functorch.get_interpreter_stack() or []
    kinds = {str(interpreter.key()).rpartition(".")[2] for interpreter in stack}
    if "Vmap" in kinds:
        raise NotImplementedError(
            "torch.func.vmap: light is not computed for many at once; "
            "ddrecon.VolumeRenderer takes batches, [n, z, y, x], one after another"
        )
    if "Grad" in kinds:
        raise NotImplementedError(
            "torch.func.grad, vjp, jacrev and hessian: light has no such transforms; "
            "use torch.autograd.grad or backward, or torch.func.jvp"
        )


def leave_uncompiled(function: F) -> F:
    """`function`, which torch.compile leaves as it is: what is around it is compiled.

    It is what `torch.compiler.disable` does, without importing torch's compiler, which takes two
    seconds of every run.
    """
    frames = torch._C._dynamo.eval_frame
    skip = frames._FrameAction.SKIP
    # What it calls is left as it is as well.
    frames.set_code_exec_strategy(function.__code__, frames._FrameExecStrategy(skip, skip))
    why = "light is computed by kernels and solvers of its own"
    vars(function).update(_torchdynamo_disable=True, _torchdynamo_disable_msg=why)
    return function


def version_of(tensor: Tensor) -> int:
    """How often `tensor` was changed in place; -1 in inference mode, where nobody counts."""
    return -1 if tensor.is_inference() else tensor._version


def is_fused(*steady: Tensor) -> bool:
    """Whether fused kernels stand for torch's operations.

    They have no tangents by tensors `steady`: where these vary in forward mode, they do not.
    """
    if current_engine() != "warp":
        return False
    return not any(forward_ad.unpack_dual(tensor).tangent is not None for tensor in steady)


def keep(ctx: Any, *tensors: Tensor) -> None:
    """Saves `tensors` in the context of a custom function, for both modes.

    For forward mode only while it is on: unlike what is saved for the backward pass, that stays in
    memory where a backward pass is to recompute it.
    """
    ctx.save_for_backward(*tensors)
    if is_forward():
        ctx.save_for_forward(*tensors)


def fill_changes(changes: Iterable[Tensor | None], values: Iterable[Tensor]) -> list[Tensor]:
    """`changes` of `values`, zero where there are none."""
    pairs = zip(changes, values, strict=True)
    return [torch.zeros_like(value) if d is None else d.expand_as(value) for d, value in pairs]


def run_plainly(function: Callable[..., Any], *tensors: Tensor | None) -> Any:
    """`function(*tensors)`, a tensor or several, which have no derivatives.

    For the `jvp` of custom functions: within torch.func as well, kernels get plain tensors.
    """
    return _Plain.apply(function, *tensors)


class _Plain(torch.autograd.Function):
    """What a function makes of tensors, which torch.func hands to it as they are."""

    @staticmethod
    def forward(function: Callable[..., Any], *tensors: Tensor | None) -> Any:
        return function(*tensors)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.mark_non_differentiable(*tensors_in(output))


def with_signature(forward: Callable[..., T]) -> Callable[..., T]:
    """The `forward` pass of a custom function that is applied often.

    torch asks for its signature each time, which takes as long as a launch unless it is known.
    """
    forward.__signature__ = inspect.signature(forward)  # type: ignore[attr-defined]
    return forward


def differentiate_once(backward: Callable[..., T]) -> Callable[..., T]:
    """The `backward` pass of a custom function whose result cannot be differentiated again.

    It raises NotImplementedError where that is asked for (`create_graph=True`). torch's
    `once_differentiable` does so only where a cotangent varies, and not on the way to every input.
    """

    @functools.wraps(backward)
    def run(ctx: Any, *bars: Tensor | None) -> T:
        _refuse_graph()
        return backward(ctx, *bars)

    return run


def _refuse_graph() -> None:
    """Raises NotImplementedError in a backward pass that is to be differentiated itself."""
    if torch.is_grad_enabled():
        raise NotImplementedError(
            "create_graph=True: only first derivatives of light are implemented"
        )


def refuse_batches(result: Tensor) -> Tensor:
    """`result`, whose backward pass raises NotImplementedError for many cotangents at once."""

    def look_at(bar: Tensor) -> None:
        if "Batched" in str(torch._C._dispatch_keys(bar)):
            raise NotImplementedError("is_grads_batched, vectorize: light has one cotangent a pass")

    if result.requires_grad:
        result.register_hook(look_at)
    return result


def recompute(function: Callable[..., T], *arguments: object) -> T:
    """`function(*arguments)`, of which only the arguments are kept for the backward pass.

    That computes it again, so `function` must not draw random numbers. It is what
    `torch.utils.checkpoint` does, without importing torch's compiler, which takes two seconds of
    every run. In forward mode, whose end may come before the backward pass, all is kept.
    """
    if not torch.is_grad_enabled() or is_forward():
        return function(*arguments)
    again = _Recomputation(lambda: function(*arguments))
    with saved_tensors_hooks(again.pack, again.unpack):
        return function(*arguments)


class _Recomputation:
    """Numbers in place of the tensors that `function` saves for its backward pass.

    When the first is asked for, `function` runs again and saves the same tensors in the same order:
    by the engine of then, and not in forward mode, as it did not before. Raises RuntimeError, as
    autograd does, where a tensor that `function` holds was changed in place since.
    """

    def __init__(self, function: Callable[[], Any]):
        self.function, self.engine = function, current_engine()
        self.versions = [(tensor, version_of(tensor)) for tensor in tensors_in(function)]
        self.count = 0
        self.saved: dict[int, Tensor] = {}

    def pack(self, _: Tensor) -> int:
        self.count += 1
        return self.count - 1

    def unpack(self, number: int) -> Tensor:
        # What is computed again has no graph that leads on to the arguments.
        _refuse_graph()
        if number not in self.saved:
            self._run()
        return self.saved.pop(number)

    def _run(self) -> None:
        if any(version_of(tensor) != version for tensor, version in self.versions):
            raise RuntimeError(
                "a tensor that light was computed from has been modified by an inplace operation "
                "since: the gradient would be that of other numbers"
            )
        saved: list[Tensor] = []
        hooks = saved_tensors_hooks(lambda tensor: saved.append(tensor.detach()), saved.__getitem__)
        level, engine = forward_ad._current_level, current_engine()
        try:
            forward_ad._current_level = -1
            if engine != self.engine:
                use_engine(self.engine)
            with torch.enable_grad(), hooks:
                self.function()
        finally:
            forward_ad._current_level = level
            if engine != self.engine:
                use_engine(engine)
        self.saved = dict(enumerate(saved))


def tensors_in(value: Any) -> Iterator[Tensor]:
    """The tensors in `value`: records, lists, tuples, mappings, and what a function has bound."""
    entries: Iterable[Any] = ()
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, list | tuple):
        entries = value
    elif isinstance(value, dict):
        entries = value.values()
    elif is_dataclass(value):
        entries = (getattr(value, key.name) for key in fields(value))
    elif isinstance(value, functools.partial):
        entries = value.func, value.args, value.keywords
    elif isinstance(value, MethodType):
        entries = (value.__self__,)
    elif isinstance(value, FunctionType):
        # An empty cell is that of a variable that has no value yet.
        cells = [cell for cell in value.__closure__ or () if cell != CellType()]
        entries = *(cell.cell_contents for cell in cells), *(value.__defaults__ or ())
    for entry in entries:
        yield from tensors_in(entry)
