"""The answer of `simulate`."""

from msgspec import Struct

from estimator.answers.answer import Answer


class Truth(Struct, frozen=True, kw_only=True):
    """The truck's parameters."""

    mass_kg: float
    A_N: float
    C_N_s2_m2: float


class ActiveEffect(Struct, frozen=True, kw_only=True):
    """An effect that was asked for.

    ``known_as`` is its name in the diagnosis, if it has one; ``active_s`` holds times from and to, none if it acts
    always.
    """

    name: str
    known_as: str | None
    magnitude: float
    unit: str
    rms_kW: float
    active_s: tuple[tuple[float, float], ...]


class SimulationAnswer(Answer, frozen=True, kw_only=True):
    """The log that was written, and the truth; ``also_acting_kW`` is the rms power of effects not asked for."""

    log: str
    frames: int
    duration_s: float
    truth: Truth
    effects: tuple[ActiveEffect, ...]
    also_acting_kW: dict[str, float]
