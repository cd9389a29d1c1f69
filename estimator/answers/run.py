"""The answer of `estimate` and `replay`."""

from msgspec import UNSET, Struct, UnsetType

from estimator.answers.answer import Answer
from estimator.answers.reference import References
from estimator.estimates import Marginal, Status


class Parameter(Struct, frozen=True, kw_only=True):
    """Marginal posterior of one parameter; without values where it is not estimated."""

    status: Status
    reason: str
    mean: float | None = None
    sd: float | None = None
    q05: float | None = None
    q50: float | None = None
    q95: float | None = None


class Parameters(Struct, frozen=True, kw_only=True):
    """Mass, rolling resistance and drag."""

    mass_kg: Parameter
    A_N: Parameter
    C_N_s2_m2: Parameter


class CoastDown(Struct, frozen=True, kw_only=True):
    """The force F = F0 + F1 v + F2 v^2, v in km/h, on a level road without wind: F0 is A, and the model has no F1."""

    F0_N: Parameter
    F1_N_h_km: float
    F2_N_h2_km2: Parameter


class Coefficients(Struct, frozen=True, kw_only=True):
    """Rolling resistance and drag in the terms of tyres, bodies and coast-down tests.

    ``c_rr`` is A / (m g), where A has all friction behind the place where power is measured, and m rotating parts.
    ``c_d_A_m2`` is 2 C / ``air_density_kg_m3``, which is the standard's (ISO 2533) unless ``is_density_measured``.
    """

    c_rr: Parameter
    c_d_A_m2: Parameter
    air_density_kg_m3: float
    is_density_measured: bool
    coast_down: CoastDown


class Convergence(Struct, frozen=True, kw_only=True):
    """Diagnostics of the chains: worst value over the parameters; draws per chain."""

    r_hat: float | None
    ess_bulk: float | None
    acceptance: float | None
    draws: int
    chains: int


class Coverage(Struct, frozen=True, kw_only=True):
    """Occupied cells of the speed x acceleration grid, of those that the vehicle can reach."""

    fraction: float
    occupied: int
    available: int


class CoverageMap(Struct, frozen=True, kw_only=True):
    """The grid of speed x acceleration: which cells were driven, and which are still wanted.

    Cell (i, j) holds speeds from i steps on, and accelerations from j steps above the lowest one on. ``rows`` has i, j
    and the rows of each cell that was driven; ``needed`` rows make it occupied. ``wanted`` has i, j of the cells that
    the newest fit found within reach of the vehicle and not occupied; none before the first fit.
    """

    speed_step_m_s: float
    acceleration_step_m_s2: float
    lowest_acceleration_m_s2: float
    needed: int
    rows: tuple[tuple[int, int, int], ...]
    wanted: tuple[tuple[int, int], ...]


class Needed(Struct, frozen=True, kw_only=True):
    """The least that an estimate is made from: samples, occupied cells, and their share of those in reach."""

    samples: int
    cells: int
    coverage: float


class Quantiles(Struct, frozen=True, kw_only=True):
    """Mean of one parameter, and its 90 % interval."""

    q05: float
    mean: float
    q95: float


class Past(Struct, frozen=True, kw_only=True):
    """A conclusion at a time since the first frame; a parameter is null where it was not estimated."""

    t_s: float
    status: Status
    mass_kg: Quantiles | None
    A_N: Quantiles | None
    C_N_s2_m2: Quantiles | None


class Road(Struct, frozen=True, kw_only=True):
    """Slopes of the road where the model has one; no height climbed where no signal shows it.

    ``contradicted``: signals that do not show it: they never change, fall where it climbs, or the force and the others
    show another road.
    """

    slope_sd: float
    length_m: float
    shown_by: tuple[str, ...]
    climbed_m: float | None
    contradicted: tuple[str, ...] = ()


class RoadNow(Struct, frozen=True, kw_only=True):
    """Grade (rise over run) under the vehicle as it was known then; height above the start where a signal shows it."""

    grade_percent: float
    sd_percent: float
    height_m: float | None
    height_sd_m: float | None


class Samples(Struct, frozen=True, kw_only=True):
    """Samples in the window, and counts of those rejected, by reason."""

    admitted: int
    rejected: dict[str, int]


class Frames(Struct, frozen=True, kw_only=True):
    """Counts of frames; ``errors`` by reason."""

    read: int
    used: int
    reordered: int
    steps_back: int
    errors: dict[str, int]


class LoadChanged(Struct, frozen=True, kw_only=True):
    """Probability that the mass after a long stop is another one than before, and both means."""

    probability: float
    mass_before_kg: float
    mass_after_kg: float


class Update(Struct, frozen=True, kw_only=True):
    """The estimate at a time since the first frame; ``load_changed`` only after a long stop.

    ``road_now`` only in a replay, where it was broadcast.
    """

    t_s: float
    status: Status
    parameters: Parameters
    load_changed: LoadChanged | UnsetType = UNSET
    road_now: RoadNow | UnsetType = UNSET


class RunAnswer(Answer, frozen=True, kw_only=True):
    """The final estimate, what went in, and every update before it.

    ``failed_updates``: numerically; ``warnings`` of what widens it, and of what may be wrong in the DBC.
    """

    status: Status
    reason: str
    advice: str
    warnings: tuple[str, ...]
    parameters: Parameters
    convergence: Convergence | None
    coverage: Coverage
    road: Road | None
    rms_kW: float | None
    samples: Samples
    frames: Frames
    failed_updates: int
    effects: tuple[str, ...]
    magnitudes: dict[str, Marginal]
    updates: tuple[Update, ...]
    coefficients: Coefficients | None = None
    coverage_map: CoverageMap | None = None
    references: References = References()
