"""In forward mode torch asks Python for zeros' shapes, 0.25 ms each; C++ knows sums, products."""

import torch

_KEY = torch._C.DispatchKey.Meta
_LIBRARY = "_meta_lib_dont_use_me_use_register_meta"
_OWN = getattr(torch._meta_registrations, _LIBRARY, None)
_NAMES = {one.split("/")[1] for one in getattr(_OWN, "_op_impls", ())}


def ask_python(everything: bool) -> None:
    """Whether torch's Python says the shapes of sums and products of tensors without memory too."""
    if not _NAMES:
        return  # a torch that keeps them elsewhere: tests take longer
    getattr(torch._meta_registrations, _LIBRARY)._destroy()
    library = torch.library.Library("aten", "IMPL", "Meta")
    setattr(torch._meta_registrations, _LIBRARY, library)
    for name in _NAMES if everything else _NAMES - {"add.Tensor", "mul.Tensor"}:
        packet, _, overload = name.partition(".")
        operation = getattr(getattr(torch.ops.aten, packet), overload or "default")
        library.impl(operation, operation.py_kernels[_KEY])
