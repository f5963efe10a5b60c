"""The numbers of a scene, by name.

`with_values(scene, values)` puts tensors in (`variables.values`); it is imported when first used.
"""

from typing import Any


def __getattr__(name: str) -> Any:
    if name != "with_values":
        raise AttributeError(f"module 'ddrecon.variables' has no attribute {name!r}")
    from ddrecon.variables.values import with_values

    return with_values
