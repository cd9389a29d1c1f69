"""The posterior that `estimate --draws` writes as JSON; parameters by their names with units."""

from msgspec import UNSET, Struct, UnsetType, field

from estimator.answers.answer import Answer

Matrix = list[list[float]]


class Summary(Struct, frozen=True, kw_only=True):
    """Moments, quantiles and convergence of one parameter."""

    mean: float
    sd: float
    q05: float
    q50: float
    q95: float
    r_hat: float | None
    ess_bulk: float | None
    ess_tail: float | None


class EigenMetrics(Struct, frozen=True, kw_only=True):
    """Eigenvalues of the information, and the angles of its eigenvectors to the axes."""

    log10_eigenvalues: list[float | None]
    angles_deg: list[list[float | None]]


class EigenMetricsPair(Struct, frozen=True, kw_only=True):
    """Metrics of the information matrix as it is, and scaled by the posterior's sd."""

    raw: EigenMetrics
    scaled: EigenMetrics


class Drag(Struct, frozen=True, kw_only=True):
    """Posterior mean and sd of the drag."""

    mean: float
    sd: float


class Air(Struct, frozen=True, kw_only=True):
    """Mean density of the air, and the drag in air of the reference density."""

    density_kg_m3: float
    reference_kg_m3: float
    C_at_reference_N_s2_m2: Drag


class DrawsAnswer(Answer, frozen=True, kw_only=True):
    """Draws (chain, draw) by parameter, with their summary; ``air`` only where the density is known.

    ``withheld``: reasons why draws of a parameter are no answer.
    """

    dims: tuple[str, ...]
    posterior: dict[str, Matrix]
    summary: dict[str, Summary]
    correlation: list[list[float | None]]
    effective_samples: float | None
    eigen_metrics: EigenMetricsPair
    air: Air | UnsetType = UNSET
    withheld: dict[str, str] = field(default_factory=dict)
