"""The numbers of a scene, by name.

`variable_names(scene)` are their names, `value_of(scene, name)` is one, and `with_values(scene,
values)` puts tensors in (`variables.values`); they are imported when first used.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ddrecon.variables.values import value_of as value_of
    from ddrecon.variables.values import variable_names as variable_names
    from ddrecon.variables.values import with_values as with_values
else:

    def __getattr__(name: str) -> Any:
        if name not in ("value_of", "variable_names", "with_values"):
            raise AttributeError(f"module 'ddrecon.variables' has no attribute {name!r}")
        from ddrecon.variables import values

        return getattr(values, name)
