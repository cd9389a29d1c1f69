"""Make the terms of nameless processes: columns with a prior, for what is not in the catalogue.

Most are hat functions along an axis, times a profile such as the speed. A swing has one period during the whole drive;
a mass on a spring and a damper oscillates after accelerations; a power or a force may be switched.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from estimator.components.likelihood import JointLikelihood
from estimator.components.term import Columns, Frame, Term
from estimator.components.time_prior import MAX_ON_SHARE, cost_without_dwell
from estimator.model.spans import Spans, covered
from estimator.preparation.recursion import recursive
from estimator.samples import STEP
from estimator.signals import Floats, Quantity
from estimator.strides import DURATION, LAGS

TIMES = (120.0, 480.0, 1920.0)  # s, distances of hats in time: shorter ones cannot be separated from slopes
GUSTS = 40.0  # s, a further distance, for drag alone: it rises with the square of the speed, as no slope does
MAX_GUSTS = 240  # hats of that distance, 2.7 h: bounds time and memory
SPEEDS = (3.0,)  # m/s
ENGINE_SPEEDS = (15.0,)  # rad/s
GEAR_RATIOS = (0.12,)  # along the logarithm of engine over road speed: about half a step between two gears of a truck
STRENGTHS = (0.1, 0.3, 1.0)  # of what is usual
GAIN_ERROR = 0.1  # share of the force, usual where a gain wanders
USUAL_POWER = 0.3  # W/kg, 8 kW for a truck of 27 t
LOWEST_TURNS = 10.0  # rad/s, of an engine that runs: its power over fewer is no torque
HIGH_TORQUE = 0.99  # quantile of the torque that counts as full load
TYPICAL_TURNS = 120.0  # rad/s of an engine, to state the torque that takes a power
MIN_PERIOD, MAX_PERIOD = 20.0, 600.0  # s, of a swing
FREQUENCY_STEP = 0.25  # largest step of its frequency, over the inverse length of the drive
SWINGS = 3  # periods that are tried
RING_PERIODS = 1.5 * 1.13 ** np.arange(12)  # s, up to 5.8
DAMPING_RATIOS = (0.05, 0.15)
LONGEST_RING = 400.0  # strides of a gap that are counted: it has rung out then
RINGING_SHARE = 0.1  # of the vehicle's mass that rings, sd of its prior
USUAL_LAG = (-0.06, 0.12)  # s, of power behind speed: control units send torque later than speed
LOW_PASS_SD = 0.05  # s^2, of half the square of the time constant of a low-pass of the speed: 0.3 s
LOW_PASS = "a low-pass of the speed"
SWITCHED_POWER, SWITCHED_FORCE = 1.2, 0.13  # W/kg and N/kg, usual: 32 kW and twice A for a truck of 27 t
SWITCHES = {"a power that switches": "W", "a force that switches": "N"}  # with the units of their size
SWING, RING = "swings", "a mass that rings on after accelerations"


def processes(frame: Frame) -> Iterator[Term]:
    """All processes but swings, in all lengths and strengths; a low-pass only if the lag is outside USUAL_LAG."""
    A, C, m = frame.road_load.tolist()
    s = frame.strides
    gusts = (GUSTS,) if s.t[-1] - s.t[0] < MAX_GUSTS * GUSTS else ()
    over = [
        ("power over time", _power, USUAL_POWER * m, s.t, TIMES),
        ("force over time", _force, 0.3 * A, s.t, TIMES),
        ("drag over time", _drag, 0.3 * C, s.t, (*TIMES, *gusts)),
        ("gain over time", _measured, GAIN_ERROR, s.t, TIMES),
        ("force over speed", _force, 0.3 * A, s.speed, SPEEDS),
    ]
    turns = s.context.get(Quantity.ENGINE_SPEED)
    if turns is not None and np.isfinite(turns).all():
        over.append(("power over engine speed", _power, USUAL_POWER * m, turns, ENGINE_SPEEDS))
        if (turns > LOWEST_TURNS).any():
            over.append(("force over gear ratio", _geared, 0.3 * A, _gear_ratio(turns, s.speed), GEAR_RATIOS))
        for strength in STRENGTHS:
            yield Term(name="gain over torque", columns=_gain_over_torque, sd=strength * GAIN_ERROR, is_noisy=True)
    for name, profile, usual, axis, lengths in over:
        for length in lengths:
            columns = _hats_times(profile, axis, length)
            for strength in STRENGTHS:
                yield Term(name=name, columns=columns, sd=strength * usual, is_noisy=profile is _measured)
    if not USUAL_LAG[0] < frame.lag < USUAL_LAG[1]:
        yield Term(name=LOW_PASS, columns=_force_curvature, sd=LOW_PASS_SD / m)
    for period in RING_PERIODS.tolist():
        for ratio in DAMPING_RATIOS:
            yield Term(name=RING, columns=_ring(period, ratio), sd=RINGING_SHARE * m, positive=True, is_noisy=True)


def swings(joint: JointLikelihood, hypotheses: Sequence[list[int]]) -> Iterator[Term]:
    """Powers and torques that swing with one period during the whole drive, for the periods of most evidence.

    Periods are searched beside each of the ``hypotheses``, which are terms of the likelihood ``joint``.
    """
    frame, s = joint.frame, joint.frame.strides
    t = s.t - s.t[0]
    profiles = [_power]
    turns = s.context.get(Quantity.ENGINE_SPEED)
    if turns is not None and np.isfinite(turns).all():
        profiles.append(_torque)
    rests = [joint.weighed_residual(chosen) for chosen in hypotheses]
    for profile in profiles:
        tried = set[float]()
        for rest in rests:
            frequencies, score = spectrum(t, frame.as_acceleration(profile(frame)) * rest)
            tried |= set(frequencies[np.argsort(-score, kind="stable")[:SWINGS]].tolist())
        # A term has a share of the process' prior; that is of all frequencies, of which few are tried.
        cost = float(np.log(len(frequencies) / len(tried)))
        for frequency in sorted(tried):
            angle = 2 * np.pi * frequency * t
            columns = _shapes_times(profile, np.column_stack([np.cos(angle), np.sin(angle)]))
            for strength in STRENGTHS:
                usual = strength * USUAL_POWER * float(frame.road_load[2])
                yield Term(name=SWING, columns=columns, sd=usual, cost=cost)


def spectrum(t: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Frequencies [Hz] (f,) that a swing may have, and the modulus (f,) of sum_k values_k exp(2 pi i f t_k).

    ``t`` [s] (n,) are times of the grid from 0 on, so a fast Fourier transform gives all frequencies.
    """
    index = np.rint(t / STEP).astype(np.int64)
    least = int(index[-1] / FREQUENCY_STEP)
    fast = (2**i * 3**j for i in range(least.bit_length() + 1) for j in range(8))  # lengths of a fast transform
    number = min(length for length in fast if length >= least)
    frequencies = np.arange(1 / MAX_PERIOD, 1 / MIN_PERIOD, 1 / (number * STEP))
    lowest = np.zeros(number, dtype=np.complex128)  # turned so that the lowest frequency comes first
    lowest[index] = values * np.exp(2j * np.pi * frequencies[0] * t)
    return frequencies, number * np.abs(np.fft.ifft(lowest)[: len(frequencies)])


def switched(frame: Frame, spans: Spans) -> Iterator[Term]:
    """Power and force that are on in ``spans`` only, without the usual dwell of an effect.

    There are none for an empty share of the drive, or one above MAX_ON_SHARE: A includes a constant force.
    """
    on = covered(frame.strides.t, DURATION, spans)[:, None]
    if not 0.0 < on.mean() <= MAX_ON_SHARE:
        return
    m, cost = float(frame.road_load[2]), cost_without_dwell(spans, frame.strides.t)
    for name, profile, usual in zip(SWITCHES, (_power, _force), (SWITCHED_POWER, SWITCHED_FORCE), strict=True):
        yield Term(name=name, columns=_shapes_times(profile, on), sd=usual * m, cost=cost, spans=spans)


def _power(frame: Frame) -> Floats:
    return np.ones(len(frame.strides))


def _torque(frame: Frame) -> Floats:
    return frame.strides.context[Quantity.ENGINE_SPEED] / TYPICAL_TURNS


def _force(frame: Frame) -> Floats:
    return frame.strides.speed


def _geared(frame: Frame) -> Floats:
    """Profile (n,) [m/s] of a force that acts while the engine turns."""
    return np.where(frame.strides.context[Quantity.ENGINE_SPEED] > LOWEST_TURNS, frame.strides.speed, 0.0)


def _gear_ratio(turns: Floats, speed: Floats) -> Floats:
    """Logarithm (n,) of engine speed over road speed; the lowest one where the engine does not turn."""
    is_turning = turns > LOWEST_TURNS
    ratio = np.log(np.where(is_turning, turns, np.inf) / speed)
    filled: Floats = np.where(is_turning, ratio, ratio.min())
    return filled


def _drag(frame: Frame) -> Floats:
    return frame.strides.speed**3


def _measured(frame: Frame) -> Floats:
    return frame.force * frame.strides.speed


def _gain_over_torque(frame: Frame) -> Floats:
    """Columns (n, 2) of gain errors that rise with the torque, and with its square, relative to the largest torque."""
    power = frame.force * frame.strides.speed
    torque = np.abs(power) / np.maximum(frame.strides.context[Quantity.ENGINE_SPEED], LOWEST_TURNS)
    share = torque / max(float(np.quantile(torque, HIGH_TORQUE)), 1.0)
    return frame.as_acceleration(np.column_stack([power * share, power * share**2]))


def _shapes_times(profile: Callable[[Frame], Floats], shapes: Floats) -> Columns:
    return lambda frame: shapes * frame.as_acceleration(profile(frame))[:, None]


def _hats_times(profile: Callable[[Frame], Floats], axis: Floats, spacing: float) -> Columns:
    """Columns of hats times a ``profile``, computed on demand to save memory: over 8 h there are 240 hats."""
    return lambda frame: hats(axis, spacing) * frame.as_acceleration(profile(frame))[:, None]


def _force_curvature(frame: Frame) -> Floats:
    """Second derivative of the force [N/s^2] (n, 1): second-order term of a low-pass of the speed, after the lag."""
    force = frame.strides.force
    middle = int(np.clip(np.argmin(np.abs(force - frame.force[:, None]).sum(axis=0)), 1, force.shape[1] - 2))
    spacing = float(LAGS[1] - LAGS[0])
    return ((force[:, middle + 1] - 2 * force[:, middle] + force[:, middle - 1]) / spacing**2)[:, None]


def _ring(period: float, ratio: float) -> Columns:
    return lambda frame: frame.as_acceleration(frame.strides.speed * ringing(frame, period, ratio))[:, None]


def ringing(frame: Frame, period: float, ratio: float) -> Floats:
    """Acceleration x'' [m/s^2] (n,), relative to the vehicle, of a mass on a spring and damper; means over strides.

    The equation is x'' + 2 d w x' + w^2 x = -a, with w = 2 pi / ``period`` [s] and the damping ``ratio`` d. The
    acceleration a is that of the force on level ground. With the complex mode q,

        q' = L q + a,    L = w (-d + i sqrt(1 - d^2)),    x'' = -a - Im(L^2 q) / Im L

    The oscillation decays freely in the gaps of a drive.
    """
    w = 2 * np.pi / period
    mode = w * complex(-ratio, np.sqrt(1 - ratio**2))
    decay = np.exp(mode * DURATION)
    reached = (decay - 1) / mode  # by q, from an acceleration of 1 during a stride
    mean = (reached / DURATION - 1) / mode  # of q, over that stride
    steps = np.minimum(
        np.rint(np.diff(frame.strides.t, prepend=frame.strides.t[0] - DURATION) / DURATION), LONGEST_RING
    )
    at = np.cumsum(steps).astype(np.int64)  # with strides of no acceleration in the gaps
    a = np.zeros(at[-1] + 1)
    a[at] = frame.view.a
    initial = np.concatenate([[0.0], recursive(reached * a, np.array([1.0, -decay]))[:-1]])
    q = initial * (decay - 1) / (mode * DURATION) + a * mean
    ring: Floats = (-a - (mode**2 * q).imag / mode.imag)[at]
    return ring


def hats(axis: Floats, spacing: float) -> Floats:
    """Hat functions (n, k) with peaks every ``spacing`` along ``axis`` (n,); they sum to one everywhere."""
    position = (axis - axis.min()) / spacing
    below, rows = np.floor(position).astype(np.int64), np.arange(len(axis))
    columns = np.zeros((len(axis), int(below.max()) + 2))
    columns[rows, below] = 1 - (position - below)
    columns[rows, below + 1] = position - below
    return columns[:, columns.any(axis=0)]
