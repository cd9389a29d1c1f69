"""Meaning of each key of the configuration: the comments in the source of its table, so that it is stated once."""

import ast
import inspect
import io
import tokenize
from functools import cache

from estimator.settings import Section


@cache
def comments_of(table: type[Section]) -> dict[str, str]:
    """The comment of each key that has one: behind it, or in the lines before it."""
    own = {name: text for base in reversed(table.__mro__[:-1]) for name, text in _comments_in(base).items()}
    return {name: own[name] for name in table.__struct_fields__ if name in own}


def _comments_in(table: type) -> dict[str, str]:
    if not issubclass(table, Section):
        return {}
    source = inspect.getsource(table)
    lines = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    (definition,) = ast.parse(source).body
    assert isinstance(definition, ast.ClassDef)
    found = {}
    for statement in definition.body:
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            texts = [lines[statement.end_lineno]] if statement.end_lineno in lines else []
            line = statement.lineno - 1
            while line in lines and _is_alone(source, line):
                texts.insert(0, lines[line])
                line -= 1
            if texts:
                found[statement.target.id] = " ".join(texts)
    return found


def _is_alone(source: str, line: int) -> bool:
    """Whether a line holds nothing but its comment."""
    return source.splitlines()[line - 1].lstrip().startswith("#")
