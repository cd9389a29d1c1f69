"""A Kalman filter of the road over strides: slope and height under the vehicle, given all strides up to the newest.

The model is that of `model/road.py` with the scales and parameters of a fit. Its state, at the middle of each stride:

    slope and its derivatives     a Matern process over distance, see `state_space`
    height since the start        the slope's integral; the altitude of the start, if an altitude is measured
    wander of each signal         a Matern process over time, of order 1 or 2
    e, f, p                       errors of speed, torque and power at both ends of the stride

Motion and readings of a stride are scalar observations, processed one by one. Here the slope is continuous; `road`
interpolates linearly between nodes 25 m apart, assigns a reading to the nearest node, and has a free end at the last.
The filter is filterpy's, with Joseph's form of the covariance.

The mean x depends linearly on the coefficients beta of the fit, so the covariance includes their uncertainty exactly
for a Gaussian beta (Schmidt 1966, "consider" parameters):

    cov = P + S cov(beta) S',   S = dx/d(beta),   S <- F S,   S <- S - K (X + H S)

It does not include the uncertainty of the scales.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_likelihood import LAG, PLAIN, columns, taken_by
from estimator.lean_import import import_lean
from estimator.model.ornstein_uhlenbeck import mean_given_ends
from estimator.model.road import START_HEIGHT_SD
from estimator.model.road_nodes import BEND, MAX_BRIDGE, SLOWEST, SPACING, ErrorScale, warping
from estimator.model.road_scales import DISTURBANCE, LENGTH, POWER, SCALES, SLOPE, SPEED, TORQUE
from estimator.model.state_space import passage, rate, stationary
from estimator.samples import over_mean
from estimator.signals import Floats
from estimator.strides import DURATION, Strides
from estimator.units import STANDARD_GRAVITY

MOST_COUNTED = 10.0  # readings near a node that count, as in `RoadModel.variances`


@dataclass(frozen=True, kw_only=True)
class Signal:
    """Signal of the road: sd of white ``noise``; ``sd`` and ``rate`` [1/s] of its wander, at ``places`` of the state.

    ``offsets`` are the indices of its constant ``errors`` among the coefficients.
    """

    name: str
    noise: float
    sd: float
    rate: float
    places: slice
    offsets: tuple[int, ...]
    errors: ErrorScale


@dataclass(frozen=True, kw_only=True)
class Belief:
    """Mean (alpha + 1,) and covariance of slope [1], its scaled derivatives and the height [m], given a stride.

    ``t`` [s] is the time of the stride's middle. The process of the slope has the order ``alpha``, the standard
    deviation ``sd`` and the ``rate`` [1/m], see `state_space`.
    """

    t: float
    mean: Floats
    covariance: Floats
    alpha: int
    sd: float
    rate: float

    def ahead(self, metres: float) -> "Belief":
        """Return the predicted belief ``metres`` further along the road."""
        forth, noise = _onward(self.alpha, self.rate * metres, metres)
        covariance = forth @ self.covariance @ forth.T + self.sd**2 * noise
        return replace(self, mean=forth @ self.mean, covariance=covariance)


class RoadFilter:
    """Kalman filter of the road; its state is that at the newest stride.

    Parameters
    ----------
    fit
        Scales, coefficients and their covariance.
    strides
        All strides of the fit, with and without known force.
    begin
        Index of the first stride to filter.
    height
        Height since the start at that stride, and its standard deviation [m].

    Attributes
    ----------
    heights : list[tuple[float, float, float]]
        Time [s] of each stride so far, the height since the start there and its standard deviation [m].
    """

    def __init__(
        self, fit: RoadFit, strides: Strides, begin: int = 0, height: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        scales = fit.scales
        self._fit, self._alpha, self._usual = fit, scales.alpha, fit.references
        self._sd, self._rate = float(scales.values[SLOPE]), rate(self._alpha, float(scales.values[LENGTH]))
        self._lay_out()
        self._ends()
        self._kalman: Any = import_lean("filterpy.kalman", deferring=["filterpy.stats"]).KalmanFilter(self._size, 1)
        self._kalman.inv = np.reciprocal  # of the variance of one observation
        self._by_coefficients = np.zeros((self._size, len(fit.beta)))  # S of the module
        self._last: tuple[float, float, float, bool] | None = None  # time, middle [m], warping, whether force is known
        self._height = height
        self.heights: list[tuple[float, float, float]] = []
        self.follow(strides[begin:], fit.departures)

    def _lay_out(self) -> None:
        """Assign the indices of the state's parts, and of the offsets among the coefficients."""
        fit, size = self._fit, self._alpha + 1
        self._has_altitude = "altitude" in fit.scales.readings
        size += self._has_altitude
        errors = [self._usual.errors[name] for name in fit.scales.readings]
        self._loads_end = at = len(fit.beta) - len(fit.terms) - sum(each.number for each in errors)  # among them
        self._signals = []
        for i, (name, error) in enumerate(zip(fit.scales.readings, errors, strict=True)):
            noise, sd, time = fit.scales.values[len(SCALES) + 3 * i :][:3].tolist()
            signal = Signal(
                name=name,
                noise=noise,
                sd=sd,
                rate=rate(fit.scales.wander, time),
                places=slice(size, size + fit.scales.wander),
                offsets=tuple(range(at, at + error.number)),
                errors=error,
            )
            self._signals.append(signal)
            size, at = size + fit.scales.wander, at + error.number
        self._first_end, self._size = size, size + 2 * (2 + fit.scales.has_power)

    def _ends(self) -> None:
        """Compute transition and noise of the errors at a stride's ends: if joined to the stride before, and if not."""
        values, size = self._fit.scales.values, self._size
        self._white = float(values[DISTURBANCE]) ** 2
        self._noises = [TORQUE, POWER][: 1 + self._fit.scales.has_power]
        errors, self._own = [(float(values[SPEED]), 0.0)], []
        for place in self._noises:
            weight, own = mean_given_ends(DURATION, values[place + 1])
            errors.append((2 * weight * float(values[place]), float(np.exp(-DURATION / values[place + 1]))))
            self._own.append(own * float(values[place]) ** 2)
        self._joined, self._unjoined = np.zeros((2, size, size)), np.zeros((2, size, size))
        for at, (sd, keep) in zip(range(self._first_end, size, 2), errors, strict=True):
            self._joined[0, at : at + 2, at + 1] = 1.0, keep
            self._joined[1, at + 1, at + 1] = sd**2 * (1 - keep**2)
            self._unjoined[1, at : at + 2, at : at + 2] = sd**2 * np.array([[1.0, keep], [keep, 1.0]])

    def follow(self, strides: Strides, departures: tuple[float, ...] = ()) -> None:
        """Filter the next strides; the mass of the fit is that after the last of the ``departures`` [s]."""
        if not len(strides):
            return
        known = np.flatnonzero(strides.known)
        driven, fit = strides[known], self._fit
        coefficients = np.zeros((len(strides), len(fit.beta)))
        coefficients[known] = self._regressors(driven, departures)
        left = np.zeros(len(strides))
        left[known] = driven.a - coefficients[known] @ fit.beta
        shares = np.zeros((len(self._noises), len(strides)))
        shares[:, known] = self._shares(driven)
        middle, length = 0.5 * (strides.s0 + strides.s1), strides.s1 - strides.s0
        factors = fit.scales.warping(length / DURATION)
        for begin, end in fit.scales.turns:
            factors[(middle > begin) & (middle < end)] = warping(np.array(SLOWEST))
        readings = [(signal, *self._readings(signal, strides, length)) for signal in self._signals]
        for i in range(len(strides)):
            self._predict(float(strides.t[i]), float(middle[i]), float(factors[i]), bool(strides.known[i]))
            if strides.known[i]:
                self._see(left[i], self._motion(shares[:, i]), self._noise(shares[:, i]), coefficients[i])
            for signal, values, variances, offsets in readings:
                if np.isfinite(values[i]):
                    self._see(values[i], self._shown(signal), variances[i], offsets[i])
            self.heights.append((float(strides.t[i]), *self._risen()))

    def belief(self) -> Belief:
        """Return the belief of the road at the middle of the newest stride, uncertainty of coefficients included."""
        n = self._alpha + 1
        assert self._last is not None
        by = self._by_coefficients[:n]
        return Belief(
            t=self._last[0],
            mean=self._kalman.x[:n, 0].copy(),
            covariance=self._kalman.P[:n, :n] + by @ self._fit.covariance @ by.T,
            alpha=self._alpha,
            sd=self._sd,
            rate=self._rate * self._last[2],
        )

    def _risen(self) -> tuple[float, float]:
        """Return the height since the start [m] and its standard deviation [m]."""
        at, by = self._alpha, self._by_coefficients[self._alpha]
        return float(self._kalman.x[at, 0]), float(np.sqrt(self._kalman.P[at, at] + by @ self._fit.covariance @ by))

    @property
    def is_shown(self) -> bool:
        """True if a signal shows the road, so that the height is known."""
        return bool(self._signals)

    def _regressors(self, driven: Strides, departures: tuple[float, ...]) -> Floats:
        """Regressors (n, p) of the acceleration of strides with a known force.

        Strides without an earlier load have zeros in its column.
        """
        fit, terms = self._fit, self._fit.terms
        density = over_mean(driven.density, self._usual.density)
        force, load = driven.force[:, fit.scales.lag], fit.road_load
        taken = taken_by(driven, force, load, terms, fit.theta[LAG + 1 :], density) if terms else 0.0
        own = columns(driven, fit.scales.lag, terms, load, departures, taken, density)
        loads = own.shape[1] - len(terms) - PLAIN  # that these strides have: the latest ones
        found = np.zeros((len(driven), len(fit.beta)))
        found[:, :PLAIN] = own[:, :PLAIN]
        found[:, self._loads_end - loads : self._loads_end] = own[:, PLAIN : PLAIN + loads]
        found[:, len(fit.beta) - len(terms) :] = own[:, PLAIN + loads :]
        return found

    def _shares(self, driven: Strides) -> Floats:
        """Factors (k, n) of the noises of torque and, if in the model, power in each stride's acceleration."""
        shares: Floats = self._usual.point.shares(driven)[: len(self._noises)]
        return shares

    def _readings(self, signal: Signal, strides: Strides, length: Floats) -> tuple[Floats, Floats, Floats]:
        """Return readings less their offsets (n,), their variances (n,), and regressors of the offsets (n, p)."""
        values = getattr(strides, signal.name) / (STANDARD_GRAVITY if signal.name == "gravity" else 1.0)
        near = np.maximum(SPACING / np.maximum(length, 0.01), 1.0)  # readings per node of the road
        variances = signal.noise**2 * np.maximum(near / MOST_COUNTED, 1.0)
        squares = np.maximum(strides.speed**2, 1e-6)
        if signal.name == "gravity":
            variances = variances + near * (BEND / squares) ** 2
        shapes = np.zeros((len(strides), len(self._fit.beta)))
        for place, shape in zip(
            signal.offsets, (np.ones(len(strides)), squares / signal.errors.mean_square), strict=False
        ):
            shapes[:, place] = np.where(np.isfinite(shape), shape, 1.0)
        return values - signal.errors.origin - shapes @ self._fit.beta, variances, shapes

    def _predict(self, t: float, middle: float, factor: float, known: bool) -> None:
        """Predict the state at the next stride, or set its prior at the first one."""
        if self._last is None:
            self._begin()
        else:
            before, place, warped, was_known = self._last
            metres, alpha = middle - place, self._alpha
            is_joined = known and was_known and abs(t - before - DURATION) < DURATION / 20
            forth, noise = (part.copy() for part in (self._joined if is_joined else self._unjoined))
            if 0 <= metres <= MAX_BRIDGE:
                u = self._rate * 0.5 * (warped + factor) * metres
                forth[: alpha + 1, : alpha + 1], own = _onward(alpha, u, metres)
                noise[: alpha + 1, : alpha + 1] = self._sd**2 * own
            else:  # after a gap, the slope is independent of that before
                forth[alpha, alpha] = 1.0
                noise[:alpha, :alpha] = self._sd**2 * stationary(alpha)
                noise[alpha, alpha] = START_HEIGHT_SD**2
            if self._has_altitude:
                forth[alpha + 1, alpha + 1] = 1.0
            for signal in self._signals:
                at = signal.places
                forth[at, at], own = passage(self._fit.scales.wander, signal.rate * (t - before))
                noise[at, at] = signal.sd**2 * own
            self._kalman.predict(F=forth, Q=noise)
            self._by_coefficients = forth @ self._by_coefficients
        self._last = t, middle, factor, known

    def _begin(self) -> None:
        spread, alpha = self._unjoined[1].copy(), self._alpha
        spread[:alpha, :alpha] = self._sd**2 * stationary(alpha)
        if self._has_altitude:
            spread[alpha + 1, alpha + 1] = START_HEIGHT_SD**2
        for signal in self._signals:
            spread[signal.places, signal.places] = signal.sd**2 * stationary(self._fit.scales.wander)
        self._kalman.P = spread
        self._kalman.x[alpha, 0], spread[alpha, alpha] = self._height[0], self._height[1] ** 2

    def _motion(self, shares: Floats) -> Floats:
        """Return the observation row (size,) of a stride's acceleration."""
        row, at = np.zeros(self._size), self._first_end
        row[0] = -STANDARD_GRAVITY
        row[at : at + 2] = -1 / DURATION, 1 / DURATION
        row[at + 2 :] = np.repeat(-0.5 * shares, 2)
        return row

    def _noise(self, shares: Floats) -> float:
        """Return the observation variance [m^2/s^4] of a stride's acceleration."""
        return self._white + float(np.dot(self._own, shares**2))

    def _shown(self, signal: Signal) -> Floats:
        """Return the observation row (size,) of a signal's reading."""
        row = np.zeros(self._size)
        if signal.name == "altitude":
            row[self._alpha : self._alpha + 2] = 1.0
        else:
            row[0] = 1.0
        row[signal.places.start] = 1.0
        return row

    def _see(self, value: float, row: Floats, variance: float, coefficients: Floats) -> None:
        """Update with one scalar observation: a ``value`` from which the coefficients' part is subtracted."""
        self._kalman.update(np.array([[value]]), R=np.array([[variance]]), H=row[None])
        gain: Floats = self._kalman.K
        self._by_coefficients -= gain * (coefficients + row @ self._by_coefficients)


def _onward(alpha: int, u: float, metres: float) -> tuple[Floats, Floats]:
    """Return transition of slope, its derivatives and height over ``metres``, and process noise for a slope sd of 1.

    ``u`` is the distance times the rate [1]. The height is integrated by the trapezoid rule.
    """
    forth, noise = np.zeros((alpha + 1, alpha + 1)), np.zeros((alpha + 1, alpha + 1))
    forth[:alpha, :alpha], noise[:alpha, :alpha] = passage(alpha, u)
    rise = 0.5 * metres
    forth[alpha, :alpha] = rise * forth[0, :alpha]
    forth[alpha, 0] += rise
    forth[alpha, alpha] = 1.0
    noise[alpha, :alpha] = rise * noise[0, :alpha]
    noise[:alpha, alpha] = noise[alpha, :alpha]
    noise[alpha, alpha] = rise**2 * noise[0, 0]
    return forth, noise
