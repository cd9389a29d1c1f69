"""Diagnose the residual of a model that is no vehicle: a driven pendulum.

python examples/pendulum.py [SEED]

The real pendulum has dry friction in its bearing; the model has only viscous friction. The residual is the measured
angular acceleration less that of the model. Candidates are columns: the residual that a cause of magnitude 1 leaves.
"""

import sys

import numpy as np
from scipy.integrate import solve_ivp

from estimator import Axis, Candidate, diagnose_residual
from estimator.signals import Floats

STIFFNESS, DAMPING, FRICTION = 9.0, 0.08, 0.04  # 1/s^2, 1/s, rad/s^2
NOISE = 0.02  # rad/s^2, of the measured acceleration
STEP, SAMPLES = 0.05, 3000  # s


def motor(t: Floats | float) -> Floats:
    """Angular acceleration [rad/s^2] (n,) that the motor gives at times [s] (n,)."""
    torque: Floats = 1.2 * np.sin(0.7 * t) * np.sin(0.11 * t)
    return torque


def friction(rate: Floats) -> Floats:
    """Dry friction (n,) per unit of its coefficient; it turns within 1 mrad/s."""
    force: Floats = -np.tanh(rate / 1e-3)
    return force


def real(t: Floats | float, state: Floats) -> Floats:
    """Rate [rad/s] and angular acceleration [rad/s^2] (2, n) of the real pendulum, from its angle and rate (2, n)."""
    angle, rate = state
    return np.array([rate, -STIFFNESS * np.sin(angle) - DAMPING * rate + FRICTION * friction(rate) + motor(t)])


def recorded(seed: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Time, angle, rate and measured acceleration (n,)."""
    t = np.arange(SAMPLES) * STEP
    start = np.array([1.2, 0.0])
    angle, rate = solve_ivp(real, (0.0, float(t[-1])), start, t_eval=t, method="LSODA", rtol=1e-7, max_step=0.02).y
    noise = np.random.default_rng(seed).normal(0.0, NOISE, SAMPLES)
    return t, angle, rate, real(t, np.array([angle, rate]))[1] + noise


def main(arguments: list[str]) -> None:
    """Print the verdict, the candidates, the budget, where the model is wrong, and how far the residual shrinks."""
    seed = int(arguments[0]) if arguments else 1
    t, angle, rate, measured = recorded(seed)
    residual = measured - (-STIFFNESS * np.sin(angle) - DAMPING * rate + motor(t))
    candidates = {
        "dry friction": Candidate(friction(rate), sd=0.1, positive=True, unit="rad/s^2"),
        "quadratic drag": Candidate(-np.abs(rate) * rate, sd=0.1, positive=True, unit="1/rad"),
        "motor gain": Candidate(motor(t), sd=0.1, unit="1"),
        "sensor offset": Candidate(np.ones(SAMPLES), sd=0.1, unit="rad/s^2"),
    }
    fitted = np.column_stack([-np.sin(angle), -rate])  # stiffness and damping are fitted anew beside every cause
    axes = {"angle": Axis(angle, "rad"), "rate": Axis(rate, "rad/s")}
    rng = np.random.default_rng(seed)
    found = diagnose_residual(residual, candidates, t, rng=rng, base=fitted, along=axes, unit="rad/s^2")

    print(f"{found.verdict.value}: {', '.join(found.named)}")
    for suspect in found.suspects:
        print(f"{suspect.name}: P = {suspect.probability:.3f}, {suspect.value:.4f} ± {suspect.sd:.4f} {suspect.unit}")
    for part in (part for part in found.budget if part.share > 0.005):
        print(f"{100 * part.share:.0f} % ({100 * part.q05:.0f} .. {100 * part.q95:.0f}) {part.cause}")
    for place in found.where[:2]:
        print(f"{place.axis} from {place.start:.2f} to {place.end:.2f} {place.unit}: {place.bias:+.3f} rad/s^2")
    rms, held_out, noise = (f"{value:.4f}" for value in (found.rms, found.held_out_rms, found.noise))
    print(f"residual {rms}, on left-out stretches {held_out} once named, noise {noise}")


if __name__ == "__main__":
    main(sys.argv[1:])
