"""Public names of a package that are imported when they are first used."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_names(
    package: str, modules: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return the functions `__getattr__` and `__dir__` and the list `__all__` of a package.

    Importing all modules of a package takes a second, and most programs need a few names. Editors
    and type checkers take the names from the file ``__init__.pyi`` of the package, which
    ``.ci/stubs.py`` writes.

    Parameters
    ----------
    package
        Name of the package.
    modules
        The names that each module defines, separated by spaces. Modules of the same package begin
        with a dot.
    """
    module_of = {name: module for module, names in modules.items() for name in names.split()}

    def load(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(module_of[name], package), name)
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted(module_of)

    return load, names, sorted(module_of)
