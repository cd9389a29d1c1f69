"""A configuration as TOML text: the standard library reads TOML but does not write it."""

import json
from collections.abc import Mapping
from typing import Any

_BARE = frozenset("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789_-")


def dump(content: Mapping[str, Any], comments: Mapping[str, str] | None = None) -> str:
    """Plain values and lists, then tables of those; keys without a value become comments.

    ``comments`` are written behind keys, by TABLE.key.
    """
    comments = comments or {}
    tables = {name: table for name, table in content.items() if isinstance(table, Mapping)}
    plain = {key: value for key, value in content.items() if key not in tables}
    parts = ["\n".join(_line(key, value, comments.get(key)) for key, value in plain.items())]
    for name, table in tables.items():
        lines = [_line(key, value, comments.get(f"{name}.{key}")) for key, value in table.items()]
        parts.append("\n".join([f"[{name}]", *lines]))
    return "\n\n".join(filter(None, parts)) + "\n"


def _line(key: str, value: Any, comment: str | None) -> str:
    if value is None:
        return f"# {_key(key)} is not set{f': {comment}' if comment else ''}"
    return f"{_key(key)} = {_value(value)}{f'  # {comment}' if comment else ''}"


def _key(key: str) -> str:
    return key if key and set(key) <= _BARE else json.dumps(key)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON's escapes are TOML's, but for the delete character.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }" if value else "{}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    return repr(value)
