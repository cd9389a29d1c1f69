"""Make the drives: simulate a plan, write its log, and store the truth with the oracle's visibility."""

import secrets
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np

from blind import oracle, seal
from blind.draw import Plan
from blind.truth import Active, Truth, key_of
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.signals import Role
from estimator.simulation import recording
from estimator.simulation.atmosphere import STANDARD_TEMPERATURE
from estimator.simulation.effects.catalogue import KINDS
from estimator.simulation.effects.rolling import settled_excess
from estimator.simulation.moment import STEP
from estimator.simulation.sensors import SPEED_RESOLUTION, TORQUE_PERIOD, Sensors
from estimator.simulation.truck import Truck
from estimator.simulation.truth import Truth as Drive

SPEED_PERIOD = 0.1  # s
WARM_SPEED = 80 / 3.6  # m/s, of the test of rolling resistance (ISO 28580), which A of `warm_up` belongs to
HILLS = 0.005, 0.015  # standard deviation of a grade that is in the configuration
GIVEN = 'effects = ["grade"]\n'  # the configuration of a hilly road
LAGS = ("time_lag", "speed_filter")  # effects equivalent to a free lag


def make(plan: Plan, seed: int, folder: Path) -> tuple[str, seal.Entry]:
    """Simulate one drive, write its log and seal its truth."""
    effects = dict(plan.effects)
    if plan.given:
        effects["grade"] = float(np.random.default_rng([seed, plan.seed, 2]).uniform(*HILLS))
    drives = [
        recording.simulate(
            plan.truck,
            plan.road,
            60.0 * plan.minutes,
            np.random.default_rng([seed, plan.seed, trip]),
            shape=plan.shape,
            effects=effects,
            sensors=plan.sensors,
        )
        for trip in range(2 if plan.effects else 1)  # the oracle measures the gap closed on the second
    ]
    log = seal.log_of(folder, plan.drive)
    write_log(frames_of(drives[0].signals), log)
    if plan.given:
        log.with_suffix(".toml").write_text(GIVEN)
    return plan.drive, seal.seal(folder, truth_from(plan, [drive.truth for drive in drives]))


def make_all(plans: list[Plan], seed: int, folder: Path, workers: int) -> Iterator[tuple[str, seal.Entry]]:
    """Make all drives, ``workers`` at a time, and publish the manifest when all are done."""
    for name in ("logs", "sealed"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    entries = {}
    with ProcessPoolExecutor(workers) as pool:
        for future in as_completed([pool.submit(make, plan, seed, folder) for plan in plans]):
            drive, entry = future.result()
            entries[drive] = entry
            yield drive, entry
    seal.publish(folder, dict(sorted(entries.items())))


def truth_from(plan: Plan, drives: list[Drive]) -> Truth:
    """The truth of a plan from its drive, and from a second drive if it has effects."""
    first, names = drives[0], tuple(plan.effects)
    known = tuple(name for name in first.effect_power if name not in names)
    views = [_view(drive, names, plan) for drive in drives]
    shares = oracle.subsets(names) if names else {}
    sensors = plan.sensors
    return Truth(
        drive=plan.drive,
        nonce=secrets.token_hex(16),
        seed=plan.seed,
        kind=plan.kind,
        minutes=plan.minutes,
        route=f"{plan.road} {plan.shape}",
        parameters={"mass_kg": plan.truck.mass, "A_N": sealed_rolling(plan), "C_N_s2_m2": sealed_drag(plan)},
        effects=tuple(_active(name, i, first, views[0], plan) for i, name in enumerate(names)),
        shown=tuple(name for name in names if _shown(name, sensors)),
        companions=known,
        gap_closed={key_of(some): oracle.gap_closed(views[0], views[-1], places) for some, places in shares.items()},
        driven=_spans(views[0].used),
        speed_noise=sensors.speed_noise,
        torque_resolution=sensors.torque_resolution,
        nuisances={
            "torque_noise_Nm": sensors.torque_noise * plan.truck.reference_torque,
            "torque_correlation_s": sensors.torque_correlation,
            "misalignment_s": sensors.torque_lag,
            "grade_noise": sensors.grade_noise,
            "altitude_noise_m": sensors.altitude_noise,
            "dropouts": sensors.dropouts,
        },
        without=tuple(sorted(role.value for role in sensors.without)),
    )


def sealed_rolling(plan: Plan) -> float:
    """A [N]: if tyres warm up at all, that of tyres as warm as in the test of rolling resistance."""
    return plan.truck.A * (1.0 + settled_excess(plan.effects.get("warm_up", 0.0), WARM_SPEED))


def sealed_drag(plan: Plan) -> float:
    """C [N s^2/m^2]: of air whose density changes and is not known, that at the start of the drive."""
    if "air_density" not in plan.effects or _shown("air_density", plan.sensors):
        return plan.truck.C
    return plan.truck.C * STANDARD_TEMPERATURE / (STANDARD_TEMPERATURE - plan.effects["air_density"] / 2)


def noise_of(sensors: Sensors, truck: Truck) -> oracle.Noise:
    """The noise of the simulated sensors in the terms of the oracle."""
    reference = truck.reference_torque
    return oracle.Noise(
        torque_sd=sensors.torque_noise * reference,
        torque_time=sensors.torque_correlation,
        torque_white_sd=sensors.torque_white_noise * reference,
        torque_step=sensors.torque_resolution * reference,
        torque_period=TORQUE_PERIOD,
        speed_sd=sensors.speed_noise,
        speed_step=SPEED_RESOLUTION,
        speed_period=SPEED_PERIOD,
    )


def _view(drive: Drive, names: tuple[str, ...], plan: Plan) -> oracle.Driven:
    """The drive in blocks; physics that the program models by default is no gap."""
    read = drive.reading
    return oracle.Driven.of(
        STEP,
        read.v,
        read.a,
        read.power,
        read.engine_speed,
        drive.driven & ~drive.braking,
        [drive.effect_power[name] for name in names],
        plan.truck.mass,
        noise_of(plan.sensors, plan.truck),
    )


def _active(name: str, i: int, drive: Drive, view: oracle.Driven, plan: Plan) -> Active:
    spans = drive.active.get(name)
    return Active(
        name=KINDS[name].known_as or name,
        world=name,
        magnitude=plan.effects[name],
        rms_kW=drive.rms_power(name) / 1e3,
        left_kW=oracle.left_over(view, i) / 1e3,
        log_bayes_factor=oracle.log_bayes_factor(oracle.signal_to_noise(view, i, aligned=name in LAGS)),
        spans=tuple((float(a), float(b)) for a, b in spans) if spans else None,
    )


def _shown(name: str, sensors: Sensors) -> bool:
    """Whether the signals are present with which the program models an effect by default."""
    if name == "air_density":
        return not sensors.without & {Role.AMBIENT_TEMPERATURE, Role.AIR_PRESSURE}
    return name == "brake_use_shown"


def _spans(used: oracle.Mask) -> tuple[tuple[float, float], ...]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], used, [False]]).astype(int))).reshape(-1, 2)
    return tuple((float(a), float(b)) for a, b in edges * oracle.BLOCK)
