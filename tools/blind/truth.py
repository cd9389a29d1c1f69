"""What the generator knows of a drive and the diagnosis must not: sealed as JSON until the score."""

from collections.abc import Iterable
from typing import Literal

import msgspec

Kind = Literal["clean", "single", "pair", "outside"]
Span = tuple[float, float]  # from, to [s]

# Log Bayes factors of the oracle: what is above the one anybody can see, what is below the other nobody can.
DETECTABLE, HIDDEN = 10.0, 1.0


class Active(msgspec.Struct, frozen=True):
    """One effect of a drive, and how well an oracle sees it.

    ``name`` as a right diagnosis says it, ``world`` as the simulated world does, ``magnitude`` in the unit there;
    ``rms_kW``: of its power while the truck is driven; ``left_kW``: of what A, C, m cannot take up;
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
    """One drive: what it was drawn as, what acted, and what an oracle makes of it.

    ``shown``: effects whose cause is known physics with its signals on the bus, which the diagnosis applies unasked.
    ``companions``: known physics that comes along, such as thinner air uphill; naming it is no error. ``driven``: when
    the engine alone moved the truck.
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
        """Of the effect that is hardest to see; infinite on a clean drive, where there is nothing to miss."""
        return min((effect.log_bayes_factor for effect in self.effects), default=float("inf"))

    @property
    def stratum(self) -> str:
        """How well an oracle sees the least visible effect."""
        return stratum(self.log_bayes_factor)


def stratum(log_bayes_factor: float) -> str:
    """Detectability in words that sort."""
    if log_bayes_factor > DETECTABLE:
        return "oracle > 10"
    return "oracle 1..10" if log_bayes_factor >= HIDDEN else "oracle < 1"


def key_of(names: Iterable[str]) -> str:
    """How a set of effects is written in ``Truth.gap_closed``."""
    return "+".join(sorted(names))
