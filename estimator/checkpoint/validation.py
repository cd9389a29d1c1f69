"""Reading saved state back: type, shape and range of every value are checked before it is used.

A state is made of dictionaries, numbers, strings, lists and numpy arrays, so that it can be stored without code in it.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import fields
from enum import StrEnum
from math import isfinite
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import DTypeLike, NDArray

from estimator.errors import StateError

State = Mapping[str, Any]
Count = Annotated[int, Meta(ge=0)]
T = TypeVar("T")
E = TypeVar("E", bound=StrEnum)


def read(state: State, name: str, kind: Any) -> Any:
    """The value called ``name``, of the type ``kind`` as `msgspec.convert` understands it; a float is finite.

    Raises
    ------
    StateError
        It is missing or of another type.
    """
    try:
        value = msgspec.convert(state[name], kind)
    except KeyError:
        raise StateError(f"{name}: is missing") from None
    except msgspec.ValidationError as error:
        raise StateError(f"{name}: {error}") from error
    if isinstance(value, float) and not isfinite(value):
        raise StateError(f"{name}: {value} is not finite")
    return value


def substate(state: State, name: str) -> State:
    """The state within a state called ``name``.

    Raises
    ------
    StateError
        It is missing or none.
    """
    found: State = read(state, name, dict[str, Any])
    return found


def optional(state: State, name: str, restore: Callable[[State], T]) -> T | None:
    """Restore the state called ``name`` within a state by ``restore``; None where it is none.

    Raises
    ------
    StateError
        It is missing.
    """
    found = read(state, name, dict[str, Any] | None)
    return None if found is None else restore(found)


def names(state: State, known: type[E]) -> list[E]:
    """The keys of a state, as members of an enumeration.

    Raises
    ------
    StateError
        One of them is unknown.
    """
    try:
        return [known(name) for name in state]
    except ValueError as error:
        raise StateError(str(error)) from error


def array(
    state: State, name: str, shape: tuple[int, ...], dtype: DTypeLike = np.float64, finite: bool = True
) -> NDArray[Any]:
    """The array called ``name`` of the given ``shape``, in which -1 is any length.

    Raises
    ------
    StateError
        It is missing, of another shape or type, or not ``finite``.
    """
    value = state.get(name)
    if not isinstance(value, np.ndarray) or value.dtype != np.dtype(dtype):
        raise StateError(f"{name}: is no array of {np.dtype(dtype)}")
    if value.ndim != len(shape) or any(want not in (-1, have) for want, have in zip(shape, value.shape, strict=True)):
        raise StateError(f"{name}: has the shape {value.shape} instead of {shape}")
    if finite and not np.isfinite(value).all():
        raise StateError(f"{name}: is not finite")
    return value


def table(columns: Any) -> dict[str, Any]:
    """State of a dataclass of arrays, and of mappings of arrays by the members of an enumeration."""
    found = {field.name: getattr(columns, field.name) for field in fields(columns)}
    return {
        name: {str(key): values for key, values in value.items()} if isinstance(value, Mapping) else value
        for name, value in found.items()
    }


def generator_state(rng: np.random.Generator) -> str:
    """State of a random generator; as text, for its integers have 128 bits."""
    return json.dumps(rng.bit_generator.state)


def set_generator(rng: np.random.Generator, state: State, name: str) -> None:
    """Continue ``rng`` from the state saved as ``name``.

    Raises
    ------
    StateError
        It is the state of no such generator.
    """
    try:
        rng.bit_generator.state = json.loads(read(state, name, str))
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise StateError(f"{name}: no state of a random generator: {error}") from error
