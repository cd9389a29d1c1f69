"""Base of all answers: their version, encoding and decoding."""

import json
from typing import Any, Literal, TypeVar

import msgspec

from estimator.printable import escaped

SCHEMA: Literal[1] = 1  # version of the answers that this program writes and reads


class Answer(msgspec.Struct, frozen=True, kw_only=True):
    """An object that the program prints or writes.

    ``schema`` is the version of all answers. It is raised when a key is renamed or removed, or when its type, unit or
    meaning changes; not when a key is added.
    """

    schema: Literal[1] = SCHEMA


Kind = TypeVar("Kind", bound=Answer)


class _Version(msgspec.Struct, frozen=True):
    """The version of an answer; required, unlike in `Answer`, whose default is for encoding."""

    schema: int


def encode(answer: Answer) -> bytes:
    """JSON without spaces, for a file; numbers that are not finite are null, bytes that are no text are escaped."""
    try:
        return msgspec.json.encode(answer, enc_hook=_number)
    except UnicodeEncodeError:
        return msgspec.json.encode(_as_text(msgspec.to_builtins(answer, enc_hook=_number)))


def decode(content: bytes | str, kind: type[Kind]) -> Kind:
    """An answer of the type ``kind`` from JSON.

    Raises
    ------
    msgspec.ValidationError
        The object has no ``schema``, another one, or not the keys of ``kind``.
    msgspec.DecodeError
        The content is not JSON.
    """
    version = msgspec.json.decode(content, type=_Version).schema
    if version != SCHEMA:
        raise msgspec.ValidationError(f"answer of schema {version}; schema {SCHEMA} is read here")
    return msgspec.json.decode(content, type=kind)


def as_text(answer: Answer) -> str:
    """JSON in ASCII with an indent of two, for standard output."""
    return json.dumps(json.loads(encode(answer)), indent=2)


def _as_text(value: Any) -> Any:
    """Copy of a value, lists and mappings included, whose texts are escaped to what UTF-8 can hold."""
    if isinstance(value, str):
        return escaped(value)
    if isinstance(value, dict):
        return {_as_text(key): _as_text(item) for key, item in value.items()}
    return [_as_text(item) for item in value] if isinstance(value, list | tuple) else value


def _number(scalar: Any) -> Any:
    """The number in a scalar of NumPy."""
    return scalar.item()
