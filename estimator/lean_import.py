"""Imports of modules without what they import and hardly need, which takes more time and memory than they do.

python-can imports asammdf wherever that is installed, and asammdf pandas: 84 MB and 0.7 s. `can_io.logs.mf4` reads the
logs that python-can would read with it. filterpy.stats imports scipy.stats, 25 MB and 0.6 to 1 s, and the Kalman filter
needs it for the likelihood alone.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType
from typing import Any


def import_without(package: str, module: str) -> ModuleType:
    """Import ``module``; to it and all that it imports, ``package`` is not installed, unless it was imported before."""
    with _in_its_place(package, None):
        return import_module(module)


def import_deferring(package: str, module: str) -> ModuleType:
    """Import ``module``; what it takes from ``package`` is imported when it is first used."""
    with _in_its_place(package, _Deferred(package)):
        return import_module(module)


@contextmanager
def _in_its_place(package: str, other: ModuleType | None) -> Iterator[None]:
    """``package`` is ``other``, or not installed, unless it was imported before."""
    if package in sys.modules:
        yield
        return
    sys.modules[package] = other  # type: ignore[assignment]  # None as the documentation of `sys.modules` has it
    try:
        yield
    finally:
        if package in sys.modules and sys.modules[package] is other:  # else it was used, and imported, meanwhile
            del sys.modules[package]


class _Deferred(ModuleType):
    """A module whose contents are imported when they are used."""

    def __getattr__(self, name: str) -> "_Content":
        if name.startswith("__"):
            raise AttributeError(name)
        return _Content(self.__name__, name)


class _Content:
    """A function or an object of a module that is imported when it is used."""

    def __init__(self, module: str, name: str) -> None:
        self._module, self._name = module, name

    def __getattr__(self, name: str) -> Any:
        return getattr(self._imported(), name)

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        return self._imported()(*arguments, **options)

    def _imported(self) -> Any:
        if isinstance(sys.modules.get(self._module), _Deferred):  # used while its user is still being imported
            del sys.modules[self._module]
        return getattr(import_module(self._module), self._name)
