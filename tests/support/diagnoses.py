"""Diagnoses made by hand, for the tests of tables, JSON and pages."""

from dataclasses import fields, replace

import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.diagnosis.result import (
    Advice,
    Diagnosis,
    Finding,
    GapClosed,
    GapMap,
    Invisible,
    Isolability,
    Magnitude,
    NotTestable,
    Place,
    Remainder,
    ResidualFormula,
    Shift,
    Span,
    Traces,
)

NAMES = ("headwind", "grade", "warm_up", "auxiliary_cycling", "auxiliary_load", "viscous_drag", "torque_bias")
MORE = ("load_loss", "rotating_inertia", "time_lag", "mass_step", "resistance_segment", "cornering", "sensor_drift")


def finding(name: str, probability: float, **changes: object) -> Finding:
    values: dict[str, object] = {
        "name": name,
        "probability": probability,
        "log_bayes_factor": 130.0 * probability - 1.3,
        "equivalent": (),
        "magnitude": Magnitude("size", 1.0, 0.21, "kW"),
        "gap_closed": None,
        "rms_before": 13_400.0,
        "rms_after": 13_300.0,
        "shift": None,
    }
    return Finding(**(values | changes))  # type: ignore[arg-type]


def drive(minutes: int = 75, seed: int = 3) -> tuple[Traces, GapMap]:
    """A drive with wind that turns with the road and a fan, and its maps."""
    rng = np.random.default_rng(seed)
    t = np.arange(60.0 * minutes)
    v = 16 + 7 * np.sin(t / 310) + 2.5 * np.sin(t / 37) + np.cumsum(rng.normal(0, 0.02, len(t)))
    a = np.gradient(v)
    base = (1700 + 3.7 * v**2 + 27_000 * a) * v
    fan = 24_000.0 * ((t % 700 > 420) & (t % 700 < 520))
    wind = 2 * 3.7 * 5.2 * v**2 * np.cos(t / 800)
    noise = np.convolve(rng.normal(0, 6500, len(t)), np.ones(4) / 4, "same")
    driving = (base > 0) & (t % 1500 > 90)
    v, a, t = v[driving], a[driving], t[driving]
    measured, extended = (base + wind + fan + noise)[driving], (base + 0.96 * wind + 0.97 * fan)[driving]
    traces = Traces(
        t=t,
        distance=np.cumsum(v),
        speed=v,
        acceleration=a,
        measured=measured,
        base=base[driving],
        extended=extended,
        road_known=extended,
        log=np.zeros(len(t)),
    )
    speeds, accelerations = np.linspace(0, 28, 15), np.linspace(-0.6, 0.6, 13)
    count = np.histogram2d(v, a, [speeds, accelerations])[0]

    def mean(residual: np.ndarray) -> np.ndarray:
        total = np.histogram2d(v, a, [speeds, accelerations], weights=residual)[0]
        return np.where(count >= 5, total / np.maximum(count, 1), np.nan)

    maps = GapMap(
        speed_edges=speeds,
        acceleration_edges=accelerations,
        plain=mean(measured - base[driving]),
        extended=mean(measured - extended),
        samples=count,
    )
    return traces, maps


def rich() -> Diagnosis:
    """A diagnosis with two effects; every field is filled."""
    traces, maps = drive()
    names = NAMES + MORE
    factors = np.random.default_rng(1).normal(size=(len(names), 6))
    factors[5] = 1.02 * factors[4] + 0.05 * factors[5]
    correlation = np.asarray(np.corrcoef(factors))
    wind = finding(
        "headwind",
        0.9996,
        magnitude=Magnitude("wind", 5.21, 0.32, "m/s"),
        gap_closed=GapClosed(0.712, 0.66, 0.755),
        rms_after=7_600.0,
        shift=Shift(-120.0, 85.0, -0.21),
        detail="from 31°",
    )
    fan = finding(
        "auxiliary_cycling",
        0.983,
        equivalent=("resistance_segment",),
        magnitude=Magnitude("power", 23.4, 1.1, "kW"),
        gap_closed=GapClosed(0.276, 0.241, 0.302),
        rms_after=3_600.0,
        shift=Shift(35.0, -60.0, 0.02),
        span=tuple(Span(700.0 * i + 420, 700.0 * i + 520) for i in range(6)),
        detail="two levels, 14 % of the time",
    )
    others = [finding(n, 0.02 * 0.5**i) for i, n in enumerate(n for n in names if n not in (wind.name, fan.name))]
    return Diagnosis(
        verdict=Verdict.EFFECT,
        effects=(wind, fan),
        candidates=(wind, fan, *others),
        remaining_verdict=Verdict.NO_GAP,
        remaining_log_bayes_factor=1.2,
        noise_floor=3_300.0,
        rms_base=13_400.0,
        rms_final=3_600.0,
        base=Shift(27_310.0, 1_712.0, 3.93),
        final=Shift(27_225.0, 1_737.0, 3.74),
        where=(
            Place(axis="heading", start=10.0, end=75.0, unit="°", bias=14_200.0, share=0.41, q_value=1e-9),
            Place(axis="speed", start=20.0, end=26.0, unit="m/s", bias=9_100.0, share=0.33, q_value=4e-6),
            Place(axis="time", start=420.0, end=520.0, unit="s", bias=22_800.0, share=0.09, q_value=0.0007),
            Place(
                axis="coolant_temperature", start=364.0, end=371.0, unit="K", bias=-3_100.0, share=0.02, q_value=0.031
            ),
        ),
        isolability=Isolability(names, correlation, np.linspace(60, -1, len(names))),
        not_testable=(NotTestable("cornering", "yaw_rate or lateral_acceleration"), NotTestable("slip", "gps_speed")),
        invisible=(
            Invisible("viscous_drag", 0.8, Shift(0.0, -310.0, -0.4), "a coast-down from 25 to 5 m/s"),
            Invisible("auxiliary_load", 2.1, Shift(12.0, -260.0, 0.0), "two minutes of idling"),
        ),
        advice=(Advice("headwind", "the same road back"), Advice("mass_step", "a weigh ticket")),
        streaming_effects=("headwind", "auxiliary_cycling"),
        gap_map=maps,
        traces=traces,
        logs=("monday/drive_0412.blf",),
    )


def several() -> Diagnosis:
    """Two logs of the same vehicle, days apart; an effect of limited duration acts in both."""
    d = rich()
    first, second = d.traces, drive(40, seed=8)[0]
    assert first is not None
    second = replace(second, t=second.t + 7.0, log=second.log + 1)
    both = {f.name: np.concatenate([getattr(first, f.name), getattr(second, f.name)]) for f in fields(Traces)}
    fan = d.effects[1]
    fan = replace(fan, span=(*fan.span[:1], Span(427.0, 527.0, 1), Span(1127.0, 1227.0, 1)))
    return replace(
        d,
        effects=(d.effects[0], fan),
        longest=Span(0.0, 4_500.0, 0),
        traces=Traces(**both),
        logs=("monday.blf", "tuesday.blf"),
        doubts=("the reference torque is another in log 2: two vehicles?",),
    )


def unknown() -> Diagnosis:
    """An effect outside the catalogue: none is named, and the traces do not change."""
    traces, maps = drive(30, seed=5)
    traces = replace(traces, extended=traces.base)
    return Diagnosis(
        verdict=Verdict.UNKNOWN,
        candidates=(finding("unknown_time", 0.97), finding("headwind", 0.03)),
        remaining_verdict=Verdict.UNKNOWN,
        remaining_log_bayes_factor=74.0,
        remainder=Remainder("power over time", 6_100.0, 74.0),
        formula=ResidualFormula(text="v t", value=4.1, sd=0.12, unit="W/m", log_bayes_factor=61.0, share=0.84),
        noise_floor=3_300.0,
        rms_base=9_100.0,
        rms_final=9_100.0,
        base=Shift(27_310.0, 1_712.0, 3.93),
        gap_map=GapMap(
            speed_edges=maps.speed_edges,
            acceleration_edges=maps.acceleration_edges,
            plain=maps.plain,
            extended=maps.plain,
            samples=maps.samples,
        ),
        traces=traces,
        logs=("a.blf", "b.blf"),
    )


def empty() -> Diagnosis:
    """Nothing could be fitted."""
    obstacle = "the log holds 40 s of driving; ten minutes are needed"
    return Diagnosis(verdict=Verdict.CANNOT_TELL, obstacle=obstacle, logs=("short.log",))
