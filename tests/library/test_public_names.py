"""What `import estimator` offers, what it costs, and how dataclasses are called."""

import ast
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from project_paths import ROOT

import estimator


@pytest.mark.parametrize("name", estimator.__all__)
def test_every_public_name_has_a_docstring(name: str) -> None:
    assert getattr(estimator, name).__doc__


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'gateway'"):
        estimator.gateway  # noqa: B018


def test_every_package_is_installed() -> None:
    root = Path(estimator.__file__).parents[1]
    listed = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    there = {".".join(path.relative_to(root).parent.parts) for path in root.glob("estimator/**/__init__.py")}
    assert set(listed) == there | {"estimator.dbc"}


def test_the_import_loads_no_numbers_and_no_bus() -> None:
    """`roadload --version` must not wait for them."""
    command = "import sys, estimator; print([name for name in ('numpy', 'can', 'scipy') if name in sys.modules])"
    run = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


MAX_POSITIONAL_FIELDS = 4


def long_dataclasses(source: str) -> Iterator[tuple[str, bool]]:
    """Name of each dataclass with more than MAX_POSITIONAL_FIELDS of its own, and whether it is keyword-only.

    Fields behind a mark KW_ONLY are.
    """
    nodes = ast.walk(ast.parse(source)) if "@dataclass" in source else ()
    for node in nodes:
        if isinstance(node, ast.ClassDef):
            decorators = [text for each in node.decorator_list if (text := ast.unparse(each)).startswith("dataclass")]
            fields = [each for each in node.body if isinstance(each, ast.AnnAssign)]
            marks = [i for i, each in enumerate(fields) if ast.unparse(each.annotation) == "KW_ONLY"]
            fields = fields[: marks[0]] if marks else fields
            if decorators and len(fields) > MAX_POSITIONAL_FIELDS:
                yield node.name, "kw_only=True" in decorators[0]


@pytest.mark.slow
def test_long_dataclasses_are_keyword_only() -> None:
    found = {
        f"{path.relative_to(ROOT)}: {name}": keyword_only
        for folder in ("estimator", "tools", "examples", "tests")
        for path in sorted(Path(ROOT, folder).rglob("*.py"))
        for name, keyword_only in long_dataclasses(path.read_text(encoding="utf-8"))
    }
    assert len(found) > 40
    assert [name for name, keyword_only in found.items() if not keyword_only] == []
