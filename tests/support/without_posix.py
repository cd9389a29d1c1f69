"""Run commands of the program as if Python had been built for Windows.

python -X warn_default_encoding tests/without_posix.py COMMAND [ARGUMENT...] [+ COMMAND [ARGUMENT...]]...

To the modules of the program, and to no others, the modules and names are missing that Python has on Linux alone, and
default encodings of text files are errors. The first sleep is interrupted, as by Ctrl-C. The names are those of
typeshed, which mypy brings.
"""

import ast
import builtins
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, NoReturn

FOREIGN = ("win32", "darwin")
ABSENT = ("curses", "fcntl", "grp", "posix", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty")
TRIMMED = ("os", "select", "signal", "socket", "sys", "time")


def missing_names(module: str) -> set[str]:
    """Names that a module of the standard library has on Linux, but not on all the FOREIGN platforms."""
    spec = find_spec("mypy")
    assert spec is not None
    assert spec.origin is not None
    stubs = Path(spec.origin).parent / "typeshed" / "stdlib"
    stub = stubs / module / "__init__.pyi"
    body = ast.parse((stub if stub.exists() else stubs / f"{module}.pyi").read_text(encoding="utf-8")).body
    linux, *others = (set(_names(body, platform)) for platform in ("linux", *FOREIGN))
    return {name for name in linux if not all(name in names for names in others)}


def _names(body: Sequence[ast.stmt], platform: str) -> Iterator[str]:
    """Names that a stub defines on a platform."""
    system = SimpleNamespace(platform=platform, version_info=sys.version_info)
    for node in body:
        if isinstance(node, ast.If):
            condition = eval(compile(ast.Expression(node.test), "stub", "eval"), {"sys": system})
            yield from _names(node.body if condition else node.orelse, platform)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Import | ast.ImportFrom):
            yield from (alias.asname or alias.name for alias in node.names)
        elif isinstance(node, ast.AnnAssign | ast.Assign):
            targets = [node.target] if isinstance(node, ast.AnnAssign) else node.targets
            yield from (target.id for target in targets if isinstance(target, ast.Name))


def trimmed(module: str) -> ModuleType:
    """A copy of a module without those names."""
    copy, missing = ModuleType(module), missing_names(module)
    copy.__dict__.update({name: value for name, value in vars(import_module(module)).items() if name not in missing})
    return copy


def interrupt(duration: float) -> NoReturn:
    """Stands for `time.sleep`."""
    raise KeyboardInterrupt


def main() -> int:
    """Exit status of the first command that fails, or 0."""
    copies = {name: trimmed(name) for name in TRIMMED}
    vars(copies["sys"])["platform"] = "win32"
    vars(copies["os"])["name"] = "nt"
    vars(copies["time"])["sleep"] = interrupt
    import_any = builtins.__import__

    def import_as_elsewhere(
        name: str,
        globals: Mapping[str, Any] | None = None,  # noqa: A002  # as `__import__` has it
        locals: Mapping[str, Any] | None = None,  # noqa: A002
        fromlist: Sequence[str] | None = (),
        level: int = 0,
    ) -> ModuleType:
        if (globals or {}).get("__name__", "").partition(".")[0] == "estimator" and level == 0:
            if name in ABSENT:
                raise ModuleNotFoundError(f"No module named {name!r}")
            if name in copies:
                return copies[name]
        return import_any(name, globals, locals, fromlist, level)

    builtins.__import__ = import_as_elsewhere
    warnings.filterwarnings("error", category=EncodingWarning, module="estimator")
    program = import_module("estimator.commands.main")
    lines = " ".join(sys.argv[1:]).split(" + ")
    return next((status for line in lines if (status := program.main(line.split()))), 0)


if __name__ == "__main__":
    sys.exit(main())
