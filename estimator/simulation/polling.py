"""Logger on the OBD-II socket of a car, which requests signals in turn from the engine."""

import numpy as np

from estimator.signals import Floats, Role, Series, Signals

ASKED = (Role.SPEED, Role.ENGINE_SPEED, Role.TORQUE_FRACTION, Role.REFERENCE_TORQUE)  # in each round, in this order
ANSWER_TIME = 0.02  # s from request to answer


def polled(signals: Signals, period: float, rng: np.random.Generator) -> Signals:
    """Answers of a control unit that measured ``signals``, each requested once in a ``period`` [s].

    An answer has the last measured value; the answers of a round are evenly spaced. The torque is that at the crank,
    after friction, as in most cars of today.
    """
    start = max(float(signals[role].t[0]) for role in ASKED)
    end = min(float(signals[role].t[-1]) for role in ASKED)
    rounds = np.arange(start + rng.uniform(0.0, period), end, period)
    answers: dict[Role, Series] = {}
    for number, role in enumerate(ASKED):
        t = rounds + number * period / len(ASKED)
        t += ANSWER_TIME * rng.uniform(0.5, 1.5, len(t)) * min(period, 1.0)
        measured = signals[role]
        value = measured.value
        if role is Role.TORQUE_FRACTION:
            value = _net(signals)
        answers[role] = Series(t, value[np.searchsorted(measured.t, t, side="right") - 1])
    return answers


def _net(signals: Signals) -> Floats:
    """Torque (n,) at the crank, as a fraction of the reference torque."""
    indicated, friction = signals[Role.TORQUE_FRACTION], signals[Role.FRICTION_FRACTION]
    value = indicated.value - np.interp(indicated.t, friction.t, friction.value)
    fine = signals.get(Role.TORQUE_FRACTION_FINE)
    return value if fine is None else value + fine.value
