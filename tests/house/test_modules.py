"""Names of modules are those of modules."""

import importlib
import pkgutil

import ddrecon


def test_nothing_that_a_package_holds_hides_a_module_of_it() -> None:
    for module_info in pkgutil.walk_packages(ddrecon.__path__, "ddrecon."):
        if not module_info.name.endswith("__main__"):
            package, _, last = module_info.name.rpartition(".")
            module = importlib.import_module(module_info.name)
            assert getattr(importlib.import_module(package), last) is module, module_info.name
