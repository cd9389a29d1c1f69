"""Clean drives with the noise of real ones: the measured speed, the power of a model, and a surrogate residual.

The model is fitted with the accelerometer revealed, so that hills are not in its residual. An accelerometer has errors
of slope of its own, 0.3 to 0.9 %, so what it shows is no more than a measurement of the road: the residual is that
beside a draw of the road from its posterior. That draw is by the model under test: slow noise that the accelerometer
leaves open goes to the road. The surrogate is a Gaussian process with that residual's own spectrum
(phase randomisation: Theiler et al. 1992, Physica D 58). Its power obeys the road load of a flat road, so every effect
named on such a drive is a false alarm. It keeps the slow variations of the real residual, so "unknown effect" is not a
false alarm.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter, welch

from estimator.config import Config
from estimator.estimation.road_fit import RoadFit, fit
from estimator.estimation.road_likelihood import Likelihood
from estimator.model.road_load import design
from estimator.preparation.admission import ADMITTED, row_reasons
from estimator.samples import STEP, Rows
from estimator.signals import Floats, Role
from estimator.streaming.drive_extraction import drives_of
from estimator.strides import Strides
from estimator.units import STANDARD_GRAVITY
from recordings import write_table

SEGMENT = 4096  # samples, 7 min: spectra are means over stretches of this length
WINDOW = 21  # rows, 2.1 s, of the polynomials that smooth the speed
TURNING = 10.0  # rad/s, of the motor, below which its torque is taken as zero
COLUMNS = """
[table.columns]
speed = "speed [m/s]"
engine_torque = "torque [N.m]"
engine_speed = "motor [rad/s]"
"""


@dataclass(frozen=True, kw_only=True)
class Original:
    """A real drive on the time grid, arrays (n,): ``speed`` as measured [m/s], model ``power`` [W], ``motor`` [rad/s].

    ``frequency`` [Hz] and ``spectrum`` [W^2/Hz] are those of the residual of the model beside the road.
    """

    speed: Floats
    motor: Floats
    power: Floats
    frequency: Floats
    spectrum: Floats

    @property
    def noise(self) -> float:
        """Root mean square [W] of the residual."""
        return float(np.sqrt(np.trapezoid(self.spectrum, self.frequency)))


def original(log: Path, config: Config, rng: np.random.Generator) -> Original | None:
    """The drive in ``log`` and the residual beside a draw of its road; None where it cannot be fitted."""
    drive = drives_of(log, config)[0]
    found = fit(drive.strides)
    if found is None:
        return None
    rows = Rows.concatenate(*drive.pieces)
    known = np.isfinite(rows.plausible_speed)
    speed = np.interp(rows.t, rows.t[known], rows.plausible_speed[known])
    v, a = (savgol_filter(speed, WINDOW, 3, deriv=n, delta=STEP) for n in (0, 1))
    felt = a + STANDARD_GRAVITY * np.interp(rows.t, found.strides.t, drawn_slope(drive.strides, found, rng))
    power = design(v, felt) @ found.theta[:3]
    pulling = (row_reasons(rows, config.admission) == ADMITTED) & (power > 0) & np.isfinite(power)
    residual = (rows.power - power)[pulling]
    frequency, spectrum = welch(residual, 1 / STEP, nperseg=min(SEGMENT, len(residual)), detrend="constant")
    return Original(
        speed=rows.speed,
        motor=rows.context[Role.ENGINE_SPEED],
        power=design(v, a) @ found.theta[:3],
        frequency=frequency,
        spectrum=spectrum,
    )


def drawn_slope(strides: Strides, found: RoadFit, rng: np.random.Generator) -> Floats:
    """The slope (n,) under the driven ``strides``, drawn from its posterior beside the coefficients that were found."""
    model = found.scales.model_of(strides)
    likelihood = Likelihood(model, found.terms, found.road_load, found.scales.lag)
    conditioned, _ = likelihood.at(found.scales.values)
    residual = likelihood.data[:, 0] - likelihood.data[:, 1:] @ (found.beta * likelihood.unit)
    return model.slope_under(model.driven, conditioned.draws(residual[:, None], rng)[:, 0])


def surrogate(like: Original, rng: np.random.Generator) -> Floats:
    """Residual [W] (n,) with the spectrum of the real one and random phases."""
    n = len(like.power)
    density = np.interp(np.fft.rfftfreq(n, STEP), like.frequency, like.spectrum)
    phases = rng.standard_normal((2, len(density)))
    noise: Floats = np.fft.irfft(np.sqrt(density * n / STEP / 4) * (phases[0] + 1j * phases[1]), n)
    return noise


def write_surrogate(like: Original, table: Path, rng: np.random.Generator) -> None:
    """A clean drive as the table that COLUMNS reads: the measured speed, and the torque of model plus surrogate."""
    power = like.power + surrogate(like, rng)
    turning = np.isfinite(power) & (like.motor > TURNING)
    torque = np.where(turning, power, 0.0) / np.where(turning, like.motor, 1.0)
    t = np.arange(len(power)) * STEP
    write_table(table, {"t": t, "speed": like.speed, "torque": torque, "motor": like.motor})
