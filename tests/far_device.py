"""A device without a GPU: its tensors have numbers, and refuse what CUDA's refuse.

A `Far` tensor is around one of the processor's, `near`. To torch it is of a device of its own:
what is made there, and every operation with it, comes by `_run`. To ddrecon it is on a GPU.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.utils._mode_utils import no_dispatch
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

_setup_privateuseone_for_python_backend("far")
FAR = torch.device("far", 0)
_HOST = torch.device("cpu")
_COPIES = {"aten::copy_", "aten::_to_copy"}
_INDEXED = {
    f"aten::{name}"
    for name in ("index", "_unsafe_index", "index_put", "index_put_", "_index_put_impl_")
}
_WITH_NUMBERS = {"aten::masked_fill", "aten::masked_fill_", "aten::fill", "aten::fill_"}
"""Operations that take single numbers from anywhere, besides those on each element."""


class Far(Tensor):
    """A tensor there, whose numbers are those of `near`."""

    near: Tensor
    is_cuda = True
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, near: Tensor) -> Far:
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

    def __repr__(self) -> str:
        return f"far {self.near}"

    def tolist(self) -> Any:
        return self.near.tolist()

    def data_ptr(self) -> int:
        return self.near.data_ptr()

    def __reduce_ex__(self, protocol: Any) -> Any:
        return self.near.__reduce_ex__(protocol)  # files of tensors are read into the processor's

    def __deepcopy__(self, known: dict[int, Any]) -> Far:
        known[id(self)] = made = Far(self.near.clone()).requires_grad_(self.requires_grad)
        return made

    @classmethod
    def __torch_dispatch__(
        cls, function: Any, types: Any, arguments: Any = (), options: Any = None
    ) -> Any:
        return _run(function, *arguments, **(options or {}))


def _run(function: Any, *arguments: Any, **options: Any) -> Any:
    """An operation where its tensors are. Raises RuntimeError where CUDA would."""
    if function == torch.ops.aten._efficientzerotensor.default:
        function = torch.ops.aten.zeros.default  # one without memory is known by a mark of its own
    given = list(_tensors((*arguments, *options.values())))
    far = {id(one.near): one for one in given if isinstance(one, Far)}
    is_far = torch.device(options.get("device") or (FAR if far else _HOST)).type == FAR.type
    if len(far) < len(given) and function._schema.name not in _COPIES:
        _require_one_device(function, arguments, given)
    generator = options.get("generator")
    if generator is not None and is_far:
        raise RuntimeError(f"{function}: a generator of {generator.device}")
    own = {id(one): one for one in given} | far
    made = function(*_near(arguments), **{key: _near(one) for key, one in options.items()})
    if torch.Tag.inplace_view in function.tags and is_far:
        with no_dispatch():
            function(*arguments)  # the shape of what is around

    def place(one: Any) -> Any:
        if isinstance(one, list | tuple):
            return type(one)(map(place, one))
        if not isinstance(one, Tensor):
            return one
        return own.get(id(one), Far(one) if is_far else one)

    return place(made)


def _require_one_device(function: Any, arguments: Any, given: list[Tensor]) -> None:
    name = function._schema.name
    takes_numbers = torch.Tag.pointwise in function.tags or name in _WITH_NUMBERS
    if name in _INDEXED:
        # Indices in the processor's memory are copied, and so are single numbers.
        if isinstance(arguments[0], Far):
            given = [one for one in arguments[2:3] if one.ndim]
        elif any(isinstance(one, Far) for one in arguments[1]):
            raise RuntimeError(
                "indices should be either on cpu or on the same device as the tensor"
            )
    elif takes_numbers:
        given = [one for one in given if isinstance(one, Far) or one.ndim]
    if not all(isinstance(one, Far) for one in given):
        raise RuntimeError(f"{name}: tensors on two devices")


def _tensors(values: Any) -> Iterator[Tensor]:
    for one in values:
        if isinstance(one, Tensor):
            yield one
        elif isinstance(one, list | tuple):
            yield from _tensors(one)


def _near(value: Any) -> Any:
    if isinstance(value, Far):
        return value.near
    if isinstance(value, list | tuple):
        return type(value)(map(_near, value))
    return _HOST if isinstance(value, torch.device) else value


@contextlib.contextmanager
def near_kernels() -> Iterator[None]:
    """Fused kernels launched there run on the processor; sweeps take a GPU's way."""
    import warp as wp

    from ddrecon.kernels import launch

    own_array, own_device = wp.from_torch, launch._device

    def array(tensor: Tensor, **options: Any) -> Any:
        return own_array(tensor.near if isinstance(tensor, Far) else tensor, **options)

    with contextlib.ExitStack() as stack:
        for owner, name, function in (
            (Far, "is_cuda", False),
            (launch, "_device", lambda _: own_device(_HOST)),
            (wp, "from_torch", array),
        ):
            stack.enter_context(patch.object(owner, name, function))
        yield


# What torch makes of Python's numbers is copied there past `__torch_dispatch__`.
_made, _copied = (torch.library.Library(name, "IMPL") for name in ("_", "aten"))
_made.fallback(_run, "PrivateUse1")
_copied.impl("copy_", functools.partial(_run, torch.ops.aten.copy_.default), "PrivateUse1")
