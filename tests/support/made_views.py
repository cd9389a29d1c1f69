"""Views with everything in them, for the tests of the screen and of the page of `watch`."""

from estimator.answers import status as answer
from estimator.answers.run import (
    CoastDown,
    Coefficients,
    Coverage,
    CoverageMap,
    Needed,
    Parameter,
    Parameters,
    Past,
    Quantiles,
    Road,
)
from estimator.answers.watch import WatchAnswer
from estimator.estimates import Status
from estimator.watch import view

STEPS = 8
CELLS = CoverageMap(
    speed_step_m_s=2.5,
    acceleration_step_m_s2=0.1,
    lowest_acceleration_m_s2=-1.0,
    needed=10,
    rows=((0, 10, 3), (1, 10, 40), (2, 11, 800), (6, 12, 9), (7, 9, 10)),
    wanted=((1, 12), (6, 12), (7, 9), (7, 11), (8, 10), (8, 11)),
)
OCCUPIED, BEGUN, WANTED = 3, 2, 4  # cells of the map above: two of the wanted ones were driven since
NEEDED = Needed(samples=600, cells=8, coverage=0.15)


def _parameter(mean: float) -> Parameter:
    sd = 0.01 * mean
    low, high = mean - 1.645 * sd, mean + 1.645 * sd
    return Parameter(status=Status.ESTIMATED, reason="", mean=mean, sd=sd, q05=low, q50=mean, q95=high)


def _history() -> tuple[Past, ...]:
    def point(k: int, mean: float) -> Quantiles:
        half = mean * 0.2 / (k + 1)
        return Quantiles(q05=mean - half, mean=mean + half / 3, q95=mean + half)

    return tuple(
        Past(
            t_s=60.0 * (k + 1),
            status=Status.ESTIMATED,
            mass_kg=point(k, 27_190.0),
            A_N=point(k, 1739.0) if k > 2 else None,
            C_N_s2_m2=point(k, 3.74),
        )
        for k in range(STEPS)
    )


def estimated(source: str = "drive.blf", unused: dict[str, int] | None = None) -> WatchAnswer:
    """A drive with an estimate of all three."""
    conclusion = answer.Estimate(
        status=Status.ESTIMATED,
        reason="",
        age_s=12.0,
        samples=9000,
        parameters=Parameters(mass_kg=_parameter(27_190.0), A_N=_parameter(1739.0), C_N_s2_m2=_parameter(3.74)),
        convergence=None,
        coverage=Coverage(fraction=0.6, occupied=54, available=90),
        t_s=480.0,
        road=Road(slope_sd=0.012, length_m=800.0, shown_by=("altitude",), climbed_m=120.0),
        coefficients=Coefficients(
            c_rr=_parameter(0.00652),
            c_d_A_m2=_parameter(6.12),
            air_density_kg_m3=1.222,
            is_density_measured=True,
            coast_down=CoastDown(F0_N=_parameter(1739.0), F1_N_h_km=0.0, F2_N_h2_km2=_parameter(3.74 / 3.6**2)),
        ),
    )
    progress = answer.Progress(t_s=492.0, samples=9000, needed=NEEDED, coverage_map=CELLS, history=_history())
    return _seen(
        source, "playing", conclusion, progress, {"braking": 700, "standing": 299} if unused is None else unused
    )


def begun(reason: str = "450 usable samples of the 600 needed", samples: int = 450) -> WatchAnswer:
    """A drive without an estimate so far."""
    nothing = Parameter(status=Status.UNESTIMATED, reason=reason)
    conclusion = answer.Estimate(
        status=Status.UNESTIMATED,
        reason=reason,
        age_s=3.0,
        samples=samples,
        parameters=Parameters(mass_kg=nothing, A_N=nothing, C_N_s2_m2=nothing),
        convergence=None,
        coverage=Coverage(fraction=0.0, occupied=0, available=0),
        t_s=60.0,
    )
    progress = answer.Progress(t_s=63.0, samples=samples, needed=NEEDED, coverage_map=CELLS, history=())
    return _seen("socketcan can0", "receiving", conclusion, progress, {})


def _seen(
    source: str, state: str, conclusion: answer.Estimate, progress: answer.Progress, unused: dict[str, int]
) -> WatchAnswer:
    return WatchAnswer(
        source=source,
        state=state,
        note="",
        share=0.43,
        frames=81_200,
        frames_per_s=12_345.0,
        estimate=conclusion,
        progress=progress,
        unused=unused,
        sentences=view.sentences(conclusion, progress),
    )
