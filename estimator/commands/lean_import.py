"""Import of a module without a package that something below it would import as well.

python-can imports asammdf wherever that is installed, and asammdf pandas: 84 MB and 0.7 s. `can_io.logs.mf4` reads the
logs that python-can would read with it.
"""

import sys
from importlib import import_module
from types import ModuleType


def import_without(package: str, module: str) -> ModuleType:
    """Import ``module``; to it and all that it imports, ``package`` is not installed, unless it was imported before."""
    if package in sys.modules:
        return import_module(module)
    sys.modules[package] = None  # type: ignore[assignment]  # as the documentation of `sys.modules` has it
    try:
        return import_module(module)
    finally:
        del sys.modules[package]
