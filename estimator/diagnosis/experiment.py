"""Find the manoeuvre or signal that separates two effects, and the log Bayes factor to expect from it.

If effect i acts with magnitude b, the expected log Bayes factor of i against j is

    1/2 b^2 h_i' K^-1 (h_i - projection of h_i on the columns of the base and h_j),

which needs the columns but no measurement. So it is computed for the strides of the drive followed by those of a
manoeuvre that has not been driven: on a level road, in the gear that is usual at its speed, without side wind.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.components.drive_state import DriveState, FittedTerm
from estimator.components.term import Term
from estimator.diagnosis.result import Experiment
from estimator.model.effects import Effect
from estimator.model.effects.effect import AtRest, Timing
from estimator.preparation.power_at_rest import IDLE_SD, IDLE_SHARE
from estimator.preparation.recursion import low_passed
from estimator.roles import PAST_SPEEDS
from estimator.signals import Floats, Quantity
from estimator.strides import DURATION, LAGS, ROWS, Strides

PART_GAP = 10.0  # s between parts of a manoeuvre, not used in the fit
STEADY = 120  # strides at each steady speed
SHARES = (0.35, 0.55, 0.75, 0.95)  # of the drive's highest speed
START_ACCELERATION, START_SPEED, STARTS = 0.7, 14.0, 10  # m/s^2, m/s at the end, how many
COASTS, MAX_COAST = 4, 240  # how many, strides of one
LOWER_GEAR = 1.35  # engine speed in the next lower gear, over that in this one: a usual step of truck gearboxes
REPEATED, MORE = 600, 1800  # strides of the drive that are repeated on the way back, or in the same direction
IDLE = AtRest(power=0.0, sd=1.0, engine_speed=63.0)  # W, W, rad/s: 600 1/min


@dataclass(frozen=True, kw_only=True)
class Manoeuvre:
    """Speeds [m/s] at the ends of strides, part by part; ``lowered``: numbers of the parts in the next lower gear."""

    name: str
    parts: tuple[Floats, ...]
    lowered: tuple[int, ...] = ()
    turned: bool = False  # driven in the opposite direction
    from_rest: bool = False  # each part begins after a stop

    @property
    def minutes(self) -> float:
        """Duration [min], with the pauses between parts."""
        return (PART_GAP + sum(len(part) * DURATION + PART_GAP for part in self.parts)) / 60


def experiments(
    state: DriveState, pairs: Sequence[tuple[Effect, Effect | None]], evidence: Mapping[str, float]
) -> tuple[Experiment, ...]:
    """The experiment with the largest expected log Bayes factor for each pair of effects.

    The second effect is None where the alternative is no effect. A pair that the drive cannot test is left out.
    ``evidence``: log Bayes factors of the effects by name, from the search.
    """
    best = []
    for effect, rival in pairs:
        effects = [effect] if rival is None else [effect, rival]
        names = {e.name for e in effects}
        rest = replace(state, chosen=tuple(term for term in state.chosen if term.name not in names))
        terms = rest.fitted_terms(effects)
        if names <= terms.keys() & evidence.keys():
            rival_term = None if rival is None else terms[rival.name]
            possible = possible_experiments(rest, terms[effect.name], rival_term, evidence)
            best.append(max(possible, key=lambda experiment: experiment.expected))
    return tuple(best)


def possible_experiments(
    state: DriveState, acting: FittedTerm, rival: FittedTerm | None, evidence: Mapping[str, float]
) -> list[Experiment]:
    """All experiments for a pair: manoeuvres, idling at rest, and a signal of the state where times were fitted.

    The gain of a manoeuvre is scaled by the ratio of the search's evidence to that of this likelihood on the drive
    itself, between 0 and 1.
    """
    a, b = acting.term.name, "" if rival is None else rival.term.name
    now = evidence[a] - (max(evidence[b], 0.0) if b else 0.0)
    trust = float(np.clip(evidence[a] / acting.gain, 0.0, 1.0)) if acting.gain > 0 else 0.0
    on_drive = expected_log_bf(state, acting, rival, None)
    gains = [
        (manoeuvre.name, manoeuvre.minutes, trust * (expected_log_bf(state, acting, rival, manoeuvre) - on_drive))
        for manoeuvre in manoeuvres(state)
    ]
    if not state.rests:
        gains.append(("two minutes of idling at rest", 2.0, _at_rest(acting, rival)))
    if acting.term.is_timed:
        gains.append(("its state on the bus", 0.0, acting.term.cost))
    return [Experiment(a=a, b=b, what=what, minutes=minutes, now=now, expected=now + g) for what, minutes, g in gains]


def expected_log_bf(
    state: DriveState, acting: FittedTerm, rival: FittedTerm | None, manoeuvre: Manoeuvre | None
) -> float:
    """Expected log Bayes factor of ``acting`` against ``rival``, from the drive and a manoeuvre after it.

    If ``rival`` is None, the Occam factor of the prior of ``acting`` is subtracted.
    """
    strides = state.strides if manoeuvre is None else Strides.concatenate([state.strides, driven(state, manoeuvre)])
    fit, end = replace(state.fit, strides=strides[strides.known]), float(strides.t[-1]) + DURATION / 2
    longer = replace(state, strides=strides, fit=fit, chosen=tuple(_lasting(term, end) for term in state.chosen))
    joint = longer.joint_with([] if rival is None else [_lasting(rival.term, end)])
    chosen = range(len(joint.terms))
    column = _lasting(acting.term, end).columns(joint.frame)
    strength = max(float(joint.projected(chosen, column)[0][0, 0]), 0.0)
    width = np.log1p(strength * acting.term.sd**2) if rival is None else 0.0
    return 0.5 * (acting.value**2 * strength - float(width))


def _lasting(term: Term, end: float) -> Term:
    """The term; one that begins at a standstill (a load) is prolonged to ``end`` [s]."""
    effect_term = term.effect_term
    if effect_term is None or effect_term.effect.timing is not Timing.STEP or not effect_term.spans:
        return term
    longer = replace(effect_term, spans=((effect_term.spans[0][0], end),))
    return replace(term, effect_term=longer, spans=longer.spans, columns=lambda frame: frame.column(longer)[:, None])


def _at_rest(acting: FittedTerm, rival: FittedTerm | None) -> float:
    """Expected log Bayes factor of a measurement of the power at idle, by the power that each effect takes at rest."""
    terms = [(fitted.value, fitted.term.effect_term) for fitted in (acting, rival) if fitted is not None]
    power = [*(0.0 if effect is None else value * effect.at_rest(IDLE) for value, effect in terms), 0.0]
    sd = IDLE_SD + IDLE_SHARE * abs(power[0])
    return 0.5 * ((power[0] - power[1]) / sd) ** 2


def manoeuvres(state: DriveState) -> Iterator[Manoeuvre]:
    """All manoeuvres that are compared, within the speeds of the drive."""
    strides = state.fit.strides
    top = float(strides.v1.max())
    steady = [share * top for share in SHARES]
    speeds = ", ".join(f"{3.6 * speed:.0f}" for speed in steady[:-1]) + f" and {3.6 * steady[-1]:.0f}"
    held = tuple(np.full(STEADY + 1, speed) for speed in steady)
    yield Manoeuvre(name=f"two minutes each at {speeds} km/h", parts=held)
    middle = np.full(STEADY + 1, steady[1])
    yield Manoeuvre(
        name=f"two minutes at {3.6 * steady[1]:.0f} km/h, and two more in the next lower gear",
        parts=(middle, middle),
        lowered=(1,),
    )
    rising = np.arange(float(strides.v0.min()), min(START_SPEED, top), START_ACCELERATION * DURATION)
    if len(rising) > 1:  # the drive has speeds below START_SPEED
        yield Manoeuvre(
            name=f"{STARTS} starts from rest to {3.6 * rising[-1]:.0f} km/h",
            parts=(rising,) * STARTS,
            from_rest=True,
        )
    rolling = _rolled(state, steady[-1], steady[0])
    yield Manoeuvre(
        name=f"{COASTS} times coasting in gear from {3.6 * steady[-1]:.0f} km/h",
        parts=(rolling,) * COASTS,
    )
    more = strides[:MORE]
    minutes = len(more) * DURATION / 60
    yield Manoeuvre(name=f"{minutes:.0f} more minutes of the same driving", parts=tuple(_pieces(more)))
    if Quantity.HEADING in strides.context:
        yield Manoeuvre(name="the same speeds on the way back", parts=tuple(_pieces(strides[:REPEATED])), turned=True)


def _rolled(state: DriveState, speed: float, end: float) -> Floats:
    """Speeds (n,) [m/s] at the ends of strides of a vehicle that coasts from ``speed`` to ``end`` [m/s]."""
    A, C, m = state.fit.theta[:3].tolist()
    speeds = [speed]
    while speeds[-1] > end and len(speeds) < MAX_COAST:
        speeds.append(speeds[-1] - DURATION * (max(A, 0.0) + max(C, 0.0) * speeds[-1] ** 2) / m)
    return np.array(speeds)


def _pieces(strides: Strides) -> Iterator[Floats]:
    """Speeds at the ends of strides, for each run of strides without a gap."""
    starts = np.flatnonzero(~strides.joined)
    for first, end in zip(starts, np.append(starts[1:], len(strides)), strict=True):
        if end - first > 1:
            yield np.append(strides.v0[first:end], strides.v1[end - 1])


def driven(state: DriveState, manoeuvre: Manoeuvre) -> Strides:
    """Strides of a manoeuvre after the drive, on a level road."""
    parts: list[Strides] = []
    for number in range(len(manoeuvre.parts)):
        parts.append(_part(state, parts[-1] if parts else state.strides, manoeuvre, number))
    return Strides.concatenate(parts)


def _part(state: DriveState, previous: Strides, manoeuvre: Manoeuvre, number: int) -> Strides:
    """Strides of part ``number`` of a manoeuvre, after the strides ``previous``."""
    t, s = float(previous.t[-1]) + PART_GAP, float(previous.s1[-1])
    speeds, factor = manoeuvre.parts[number], LOWER_GEAR if number in manoeuvre.lowered else 1.0
    strides, n = state.fit.strides, len(speeds) - 1
    A, C, m = state.fit.theta[:3].tolist()
    v0, v1 = speeds[:-1], speeds[1:]
    v, a = 0.5 * (v0 + v1), (v1 - v0) / DURATION
    ends = s + np.concatenate([[0.0], np.cumsum(v * DURATION)])
    order = np.argsort(strides.speed)
    gearing = factor * np.interp(v, strides.speed[order], strides.filled_gearing(strides.usual_turns)[order])
    force, unknown, times = A + C * v**2 + m * a, np.full(n, np.nan), t + DURATION * (np.arange(n) + 0.5)
    driven_context = {
        Quantity.ENGINE_SPEED: gearing * v,
        Quantity.STOPS: np.full(n, _last_known(previous, Quantity.STOPS) + manoeuvre.from_rest),
        Quantity.ELAPSED: _last_known(previous, Quantity.ELAPSED) + times - float(previous.t[-1]),
        Quantity.HEADING: np.full(n, _last_known(state.strides, Quantity.HEADING) + np.pi * manoeuvre.turned),
        Quantity.LATERAL_ACCELERATION: np.zeros(n),
        **{q: low_passed(v, _last_known(previous, q), DURATION, time) for q, time in PAST_SPEEDS.items()},
    }
    context = {q: driven_context.get(q, np.full(n, _last_known(state.strides, q))) for q in state.strides.context}
    return Strides(
        t=times,
        rows=np.full(n, ROWS),
        known=np.ones(n, dtype=bool),
        v0=v0,
        v1=v1,
        s0=ends[:-1],
        s1=ends[1:],
        a=a,
        speed_squared=v**2,
        force=np.repeat(force[:, None], len(LAGS), axis=1),
        gearing=gearing,
        density=np.full(n, float(np.nanmean(strides.density)) if np.isfinite(strides.density).any() else np.nan),
        altitude=unknown,
        grade=unknown,
        grade_offset_sd=unknown,
        gravity=unknown,
        context=context,
    )


def _last_known(strides: Strides, quantity: Quantity) -> float:
    """The last known value of a quantity; 0 where there is none."""
    values = strides.context.get(quantity, np.empty(0))
    finite = values[np.isfinite(values)]
    return float(finite[-1]) if len(finite) else 0.0
