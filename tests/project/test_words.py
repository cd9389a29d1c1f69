"""Docstrings say what a thing is or does: none begins with a word that leans on the docstring above it."""

import ast
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

import estimator

ROOT = Path(estimator.__file__).parent
PACKAGES = sorted(path.parent.name for path in ROOT.glob("*/__init__.py"))
BEGINNINGS = ("As", "By", "From", "Of", "That", "The same", "What", "With")
DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def docstrings(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of every docstring in a module."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, DOCUMENTED) and (text := ast.get_docstring(node)):
            yield node.body[0].lineno, text


def vague(paths: Iterable[Path]) -> list[str]:
    """List the docstrings of modules that begin with one of BEGINNINGS, with their places."""
    beginnings = tuple(f"{word} " for word in BEGINNINGS)
    return [
        f"{path.relative_to(ROOT)}:{line}: {text[:60]}"
        for path in sorted(paths)
        for line, text in docstrings(path)
        if text.startswith(beginnings)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("package", PACKAGES)
def test_no_docstring_begins_with_a_word_that_leans_on_another(package: str) -> None:
    assert vague((ROOT / package).rglob("*.py")) == []


def test_nor_does_one_of_a_module_outside_the_packages() -> None:
    assert vague(ROOT.glob("*.py")) == []
