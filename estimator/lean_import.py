"""Imports of modules without what they import and hardly need, which takes more time and memory than they do.

python-can imports asammdf wherever that is installed, and asammdf pandas: 84 MB and 0.7 s. `can_io.logs.mf4` reads the
logs that python-can would read with it. filterpy.stats imports scipy.stats, 25 MB and 0.6 to 1 s, and the Kalman filter
needs it for the likelihood alone. scipy takes everything from numpy, and its compiler of Fortran with it: 0.15 s.
"""

import sys
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import LazyLoader
from types import ModuleType
from typing import Any


def import_lean(
    module: str, *, without: Collection[str] = (), deferring: Collection[str] = (), lazy: Collection[str] = ()
) -> ModuleType:
    """Import ``module``, and all that it imports, with less of some packages.

    Packages ``without`` which it can do are not installed to it. Packages that are ``lazy`` are imported when the first
    of their contents is taken; of those ``deferring``, contents may be taken and are imported when they are used.
    Packages that were imported before stay as they are.
    """
    with ExitStack() as replaced:
        for package in without:
            replaced.enter_context(_in_its_place(package, None))
        for package in deferring:
            replaced.enter_context(_in_its_place(package, _Deferred(package)))
        finder = _LazyFinder(lazy)
        sys.meta_path.insert(0, finder)
        replaced.callback(sys.meta_path.remove, finder)
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


class _LazyFinder(MetaPathFinder):
    """Finds packages and loads them when the first of their contents is taken."""

    def __init__(self, packages: Collection[str]) -> None:
        self._packages = packages

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Specification of a lazy package; None of all others, which the next finder looks for."""
        spec = PathFinder.find_spec(fullname, path, target) if fullname in self._packages else None
        if spec is not None and spec.loader is not None:
            spec.loader = LazyLoader(spec.loader)
        return spec


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
