"""The paper's drive cycles at 1 Hz: HWFET from a table, COMMUT from its description, HHDDTNC from recorded tables."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from harness.drives import data_folder
from scipy.optimize import brentq

from estimator.signals import Floats
from paper.vehicles import MPH

SHIPPED = Path(__file__).parents[1] / "cycles"
HHDDT_MODES = ("EPA_Ph2_transient", "hhddt_cruise3")  # transient and cruise; the paper leaves out creep ("NC")

COMMUT_IDLE, COMMUT_LAUNCH, COMMUT_CRUISE, COMMUT_BRAKE = 20.0, 90.0, 188.0, 12.0  # s; idle at both ends
COMMUT_SPEED = 55 * MPH
COMMUT_LENGTH = 4 * 1609.344  # m


@dataclass(frozen=True)
class Cycle:
    """Speed ``v`` [m/s] and acceleration ``a`` [m/s^2] of ``name``, one value a second."""

    name: str
    v: Floats
    a: Floats

    @classmethod
    def of(cls, name: str, *speeds: Floats) -> "Cycle":
        """Join parts, speeds (n,) [m/s] each; accelerations are central differences inside each part."""
        return cls(name, np.concatenate(speeds), np.concatenate([np.gradient(v) for v in speeds]))

    @classmethod
    def joined(cls, cycles: "list[Cycle]") -> "Cycle":
        """All of ``cycles``, one after the other."""
        return cls("all cycles", np.concatenate([c.v for c in cycles]), np.concatenate([c.a for c in cycles]))

    def repeated(self, copies: int) -> "Cycle":
        """``copies`` of the cycle, one after the other."""
        return Cycle(self.name, np.tile(self.v, copies), np.tile(self.a, copies))

    def __getitem__(self, part: slice) -> "Cycle":
        return Cycle(self.name, self.v[part], self.a[part])

    @property
    def duration(self) -> int:
        """Number of seconds."""
        return len(self.v)

    @property
    def miles(self) -> float:
        """Distance [mi]."""
        return float(self.v.sum()) / 1609.344


def _table(path: Path) -> Floats:
    rows = [line for line in path.read_text().splitlines() if line[:1].isdigit()]
    return np.array([float(row.split(",")[1]) for row in rows])


def _commut() -> Floats:
    """Commuter phase of SAE J1376, from its description.

    Idle 20 s, 90 s to 55 mph, 188 s at 55 mph, 12 s of even braking to a standstill, idle 20 s; 4 miles. The launch
    is the exponential approach that makes the distance right.
    """
    launch = (COMMUT_LENGTH - COMMUT_SPEED * (COMMUT_CRUISE + COMMUT_BRAKE / 2)) / (COMMUT_SPEED * COMMUT_LAUNCH)
    # Launch over k time constants has the mean speed 1 / (1 - exp(-k)) - 1 / k of the last.
    k = brentq(lambda k: 1 / -np.expm1(-k) - 1 / k - launch, 0.1, 50.0)
    t = np.arange(2 * COMMUT_IDLE + COMMUT_LAUNCH + COMMUT_CRUISE + COMMUT_BRAKE)
    rise = np.expm1(-k * np.clip((t - COMMUT_IDLE) / COMMUT_LAUNCH, 0, 1)) / np.expm1(-k)
    fall = np.clip((COMMUT_IDLE + COMMUT_LAUNCH + COMMUT_CRUISE + COMMUT_BRAKE - t) / COMMUT_BRAKE, 0, 1)
    speed: Floats = COMMUT_SPEED * rise * fall
    return speed


def shipped_parts() -> dict[str, tuple[Floats, ...]]:
    """Speeds [m/s] (n,) of the cycles that come with the project, as uninterrupted parts: HWFET and COMMUT.

    HWFET is the EPA Highway Fuel Economy driving schedule, 40 CFR part 600, appendix I.
    """
    return {"HWFET": (_table(SHIPPED / "hwfet.csv"),), "COMMUT": (_commut(),)}


def all_parts() -> dict[str, tuple[Floats, ...]]:
    """Speeds [m/s] (n,) of all three cycles, as uninterrupted parts.

    Raises
    ------
    InputError, FileNotFoundError
        The folder of recordings, or a table of the Heavy Heavy-Duty Diesel Truck schedule, is missing.
    """
    recorded = data_folder() / "drive_cycles" / "csv"
    return shipped_parts() | {"HHDDTNC": tuple(_table(recorded / f"{mode}.csv") for mode in HHDDT_MODES)}


def cycles_of(parts: dict[str, tuple[Floats, ...]]) -> dict[str, Cycle]:
    """Cycles by name, with central differences as acceleration."""
    return {name: Cycle.of(name, *speeds) for name, speeds in parts.items()}
