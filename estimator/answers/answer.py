"""What all answers have in common: the version, and the encoding."""

import json
from typing import Any, Literal

import msgspec


class Answer(msgspec.Struct, frozen=True, kw_only=True):
    """An object that the program prints or writes.

    ``schema`` is the version of all answers. It is raised when a key is renamed or removed, or when its type, unit or
    meaning changes; not when a key is added.
    """

    schema: Literal[1] = 1


def encode(answer: Answer) -> bytes:
    """JSON without spaces, for a file; numbers that are not finite are null."""
    return msgspec.json.encode(answer, enc_hook=_number)


def as_text(answer: Answer) -> str:
    """JSON in ASCII with an indent of two, for standard output."""
    return json.dumps(json.loads(encode(answer)), indent=2)


def _number(scalar: Any) -> Any:
    """The number in a scalar of NumPy."""
    return scalar.item()
