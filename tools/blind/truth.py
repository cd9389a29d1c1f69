"""The truth of a drive, sealed as JSON until the score."""

from collections.abc import Iterable
from typing import Literal

import msgspec

Kind = Literal["clean", "single", "pair", "outside"]
Span = tuple[float, float]  # from, to [s]

# Log Bayes factors of the oracle: an effect above the first is visible, one below the second is not.
DETECTABLE, HIDDEN = 10.0, 1.0


class Active(msgspec.Struct, frozen=True):
    """One effect of a drive, and its visibility to the oracle.

    ``name`` in the diagnosis, ``world`` in the simulation, ``magnitude`` in the simulation's unit;
    ``rms_kW``: of its power while the truck is driven; ``left_kW``: of its residual after fitting A, C, m;
    ``log_bayes_factor``: of the oracle, given the other effects; ``spans``: when it acts, None unless it is bounded.
    """

    name: str
    world: str
    magnitude: float
    rms_kW: float
    left_kW: float
    log_bayes_factor: float
    spans: tuple[Span, ...] | None = None


class Truth(msgspec.Struct, frozen=True):
    """One drive: its plan, the effects at work, and their visibility to the oracle.

    ``shown``: effects of known physics with their signals on the bus, which the diagnosis models by default.
    ``companions``: known physics caused by the drive, such as thinner air uphill; naming it is no error.
    ``driven``: when the engine alone moved the truck.
    ``gap_closed``: for every set of the drive's effects, written ``a+b`` in alphabetic order, the share of the gap
    that adding them with their true parameters closes on a second drive of the same truck on another road.
    """

    drive: str
    nonce: str
    seed: int
    kind: Kind
    minutes: float
    route: str
    parameters: dict[str, float]  # mass_kg, A_N, C_N_s2_m2
    effects: tuple[Active, ...]
    shown: tuple[str, ...]
    companions: tuple[str, ...]
    gap_closed: dict[str, float]
    driven: tuple[Span, ...]
    speed_noise: float  # m/s
    torque_resolution: float  # share of the reference torque
    nuisances: dict[str, float]
    without: tuple[str, ...]  # optional signals that are not on the bus

    @property
    def log_bayes_factor(self) -> float:
        """Log Bayes factor of the least visible effect; infinite on a clean drive."""
        return min((effect.log_bayes_factor for effect in self.effects), default=float("inf"))

    @property
    def stratum(self) -> str:
        """Visibility of the least visible effect."""
        return stratum(self.log_bayes_factor)


def stratum(log_bayes_factor: float) -> str:
    """Visibility as text; alphabetic order is the order of visibility."""
    if log_bayes_factor > DETECTABLE:
        return "oracle > 10"
    return "oracle 1..10" if log_bayes_factor >= HIDDEN else "oracle < 1"


def key_of(names: Iterable[str]) -> str:
    """Key of a set of effects in ``Truth.gap_closed``."""
    return "+".join(sorted(names))
