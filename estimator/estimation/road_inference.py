"""One update with the road as a state: fit, judge each parameter by itself, sample.

The mass follows from the change of speed with force within seconds, A and C from the means of force and slope. Over
hills that no signal shows the mass is known long before A and C, so each parameter has its own status.
"""

from collections import Counter
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from estimator.checkpoint.validation import (
    Count,
    State,
    generator_state,
    optional,
    read,
    set_generator,
    substate,
)
from estimator.config import Config
from estimator.errors import StateError
from estimator.estimates import PARAMETERS, Coverage, Estimate, Road, Status
from estimator.estimation import posterior
from estimator.estimation.belief import Belief
from estimator.estimation.continued import Continued
from estimator.estimation.evidence import Coefficients, Evidence, Trace
from estimator.estimation.gain_changes import EACH_LOAD, gain_changes
from estimator.estimation.gate import NAMES, PEAK_QUANTILE, Gate, Judged, wrong_sign_of, wrong_unit_of
from estimator.estimation.load_segments import KEPT_LOADS, SHORT_STOP, Loads, Segment
from estimator.estimation.model_check import contradiction
from estimator.estimation.road_fit import (
    MIN_INVERSE_MASS,
    RoadFit,
    fit,
    fit_given,
    most_probable_scales,
    search_of,
)
from estimator.estimation.road_likelihood import LAG_SD, ROAD_LOAD
from estimator.estimation.road_posterior import RoadTarget
from estimator.estimation.road_signals import constant, contradicted, reversed_in, shown_by
from estimator.estimation.scale_check import ScaleCheck
from estimator.estimation.scales import RoadScales
from estimator.estimation.shapes import averaged, fitted_with_shapes, terms_of
from estimator.estimation.usual_vehicles import Doubt, Size, unusual
from estimator.estimation.window import Window
from estimator.model.effect_term import EffectTerm
from estimator.model.effects import obstacle, way_past_obstacle
from estimator.model.road_nodes import SIGNALS
from estimator.model.road_scales import POWER, TORQUE
from estimator.preparation.stage import moving_effects
from estimator.roles import is_electric
from estimator.signals import Floats, Quantity
from estimator.strides import DURATION, LAGS, Strides

# Factor by which the window must grow before the scales of road and noise are searched again. Searched in every update,
# three drives of 40 min took 1.6 times as much processor time, and their masses moved by at most 0.14 sd.
MIN_GROWTH = 1.5
# Limits of a fit that describes the drive; in brackets the worst of five simulated drives and of seven of a BMW i3.
MIN_EXPLAINED = 0.5  # of the variance of acceleration, by the vehicle and the road (0.99, 0.85)
MAX_SLOPE_SD = 0.06  # sine of the slope: larger than on any road (0.014, 0.024)
MAX_NOISE = 0.3  # m/s^2 of noise of torque or power over mass (0.02, 0.09)
MIN_DRIVEN = 0.1  # share of the driving: over hidden hills, less is where the slope lets a vehicle pull (a pass: 0.04)
USUAL_LAG = 0.5  # s, between power and speed, may be more only where `kinematics.maximum_lag_s` is above its default
LONGEST_LAG = float(LAGS.max()) + LAG_SD  # s, that the model can describe
EDGE_SDS = 2.0  # sd outside its box at which a fit contradicts the box; inside by less, the parameter is withheld
NOTHING_COVERED = Coverage(0, 0)


class Withheld(Protocol):
    """Makes an estimate without values."""

    def __call__(
        self, reason: str, coverage: Coverage = ..., status: Status = ..., remedy: str | None = ...
    ) -> Estimate:
        """The estimate with its reason."""
        ...


class RoadInference:
    """Makes estimates from a window of strides, and keeps the segments of the loads.

    Parameters
    ----------
    config
        All settings.
    window
        The strides that estimates are made from.
    rng
        Source of all randomness.
    """

    def __init__(self, config: Config, window: Window, rng: np.random.Generator) -> None:
        self.evidence: Evidence | None = None  # of the newest estimate
        self._config = config
        self._window = window
        self._gate = Gate(config.gate, window.grid)
        self._effects = moving_effects(config)
        self._given = Belief.configured(config.prior)
        self._rng = rng
        self._loads = Loads()
        self._scales: RoadScales | None = None
        self._fitted = 0  # rows in the window when the scales were found
        self._departures: tuple[float, ...] = ()  # [s] between the loads in the window
        self._signals: tuple[str, ...] = ()  # of the road, that were compared
        self._compared = 0  # rows in the window then
        self._contradicted: tuple[str, ...] = ()  # those left out, until there are others or another drive
        self._continued = Continued()

    def start_segment(self, departure: float | None = None) -> float | None:
        """Begin a new load at ``departure`` [s], None at the start of a drive: the present one becomes the one before.

        Returns the time [s] from which on driving stays in use, None where all of it is discarded.
        """
        kept = departure is not None and self._config.load.stop_s < SHORT_STOP
        if departure is None and self._scales is not None:
            self._scales = replace(self._scales, turns=())  # of the road before
        self._loads.start_segment(kept)
        self.evidence = None
        self._continued.forget()
        if departure is None or not kept:
            self._fitted, self._compared, self._departures, self._contradicted = 0, 0, (), ()
            return None
        departures = (*self._departures, departure)
        self._departures = departures[-KEPT_LOADS:]
        return departures[-KEPT_LOADS - 1] if len(departures) > KEPT_LOADS else -np.inf

    def forget_vehicle(self) -> None:
        """Discard the segments: the vehicle may be another one."""
        self._loads.forget_vehicle()
        self._scales = None

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads; the evidence is left out, for the next update computes it."""
        return {
            "generator": generator_state(self._rng),
            "loads": self._loads.state(),
            "scales": None if self._scales is None else self._scales.state(),
            "lost": [] if self._scales is None else [lost.state() for lost in self._scales.lost],
            "fitted": self._fitted,
            "departures": list(self._departures),
            "contradicted": list(self._contradicted),
            "signals": list(self._signals),
            "compared": self._compared,
            "continued": self._continued.state(),
        }

    def restore(self, state: State) -> None:
        """Take the state of another one.

        Raises
        ------
        StateError
            The state is not that of an inference.
        """
        set_generator(self._rng, state, "generator")
        self._continued.restore(substate(state, "continued"))
        self._loads.restore(substate(state, "loads"))
        self._scales = optional(state, "scales", RoadScales.restored)
        lost = tuple(map(RoadScales.restored, read(state, "lost", list[dict[str, Any]])))
        if self._scales is not None:
            if any(scales.readings != self._scales.readings for scales in lost):
                raise StateError("lost: scales of other signals")
            self._scales = replace(self._scales, lost=lost)
        self._fitted = read(state, "fitted", Count)
        self._departures = tuple(read(state, "departures", list[float]))
        self._contradicted = tuple(read(state, "contradicted", list[str]))
        self._signals = tuple(read(state, "signals", list[str]))
        self._compared = read(state, "compared", Count)
        if not {*self._contradicted, *self._signals} <= set(SIGNALS):
            raise StateError("contradicted, signals: are not those of the road")
        if np.any(np.diff(self._departures) <= 0):
            raise StateError("departures: do not rise")

    def recover(self, state: State) -> None:
        """Return to the ``state`` before an update that failed.

        The scales of road and noise may be why, so the next update finds them from the centres of their priors.
        """
        self.restore({**state, "scales": None, "fitted": 0, "compared": 0})
        self.evidence = None

    def conclude(
        self, t: float, context: frozenset[Quantity], scale: ScaleCheck, rejected: Counter[str], is_last: bool
    ) -> Estimate:
        """The estimate at time ``t`` [s].

        ``context`` that the strides carry; ``scale`` of the speed as the bus shows it; rows ``rejected`` before, by
        reason. The last estimate before a gap or of a load is of the whole window, as a diagnosis has it.
        """
        self.evidence = None
        strides, held = self._window.strides, len(self._window)

        def withheld(
            reason: str,
            coverage: Coverage = NOTHING_COVERED,
            status: Status = Status.UNESTIMATED,
            remedy: str | None = None,
        ) -> Estimate:
            return Estimate(t=t, status=status, reason=reason, coverage=coverage, admitted=held, remedy=remedy)

        if reason := scale.verdict():
            return withheld(reason, status=Status.INVALID)
        if reason := obstacle(self._effects, context):
            return withheld(reason, remedy=way_past_obstacle(self._effects, context))
        if reason := self._gate.missing_rows(held, rejected):
            return withheld(reason)
        driven = strides[strides.known]
        if reason := wrong_sign_of(driven.power, driven.a):
            return withheld(reason + self._other_sign(), remedy="")
        if reason := wrong_unit_of(driven.power / driven.speed, driven.a, self._config.prior.mass_kg[0]):
            return withheld(reason, status=Status.INVALID)
        found = self._fit(strides, held, is_last)
        if found is None:
            return withheld("speed and acceleration varied too little to tell A, C and m apart")
        if reason := self._undetermined(found):
            return withheld(reason)
        doubt = self._unusual(found, scale)
        if doubt.is_certain:
            return withheld(doubt.sentence, status=Status.INVALID)
        changes = gain_changes(found)
        conflict, found = changes.contradiction(found), changes.averaged(found).checked()
        if reason := self._undetermined(found):
            return withheld(conflict, remedy=EACH_LOAD) if conflict else withheld(reason)
        estimate = self._judge(t, found, conflict, withheld)
        return replace(estimate, doubt=doubt.sentence) if estimate.status is Status.ESTIMATED else estimate

    def _fit(self, strides: Strides, held: int, is_last: bool) -> RoadFit | None:
        grown = _has_changed(held, self._fitted, MIN_GROWTH)
        without_change = constant(strides)
        strides, signals = strides.without(without_change), tuple(shown_by(strides))
        is_due = _has_changed(held, self._compared, MIN_GROWTH**3)  # each third search
        if signals != self._signals or (is_due and not self._contradicted):
            self._signals, self._compared, limit = signals, held, self._config.kinematics.maximum_lag_s
            self._contradicted = contradicted(strides, lambda seen: search_of(seen, (), limit, self._departures))
            self._continued.forget()  # it may have had other signals
        strides = strides.without(self._contradicted)
        terms = terms_of(
            strides, self._effects, lambda: self._fitted_beside(strides, (), self._scales, is_last, is_search=False)
        )
        found = fitted_with_shapes(
            strides,
            terms,
            lambda terms, known: self._fitted_beside(strides, terms, known or self._scales, is_last, grown),
        )
        if found is None:
            return None
        if grown or self._scales is None or found.scales.readings != self._scales.readings:
            self._fitted = held
        self._scales = found.scales
        return replace(averaged(strides, found).checked(), contradicted=(*without_change, *self._contradicted))

    def _fitted_beside(
        self, strides: Strides, terms: tuple[EffectTerm, ...], scales: RoadScales | None, is_last: bool, is_search: bool
    ) -> RoadFit | None:
        """Fit ``terms`` at the given ``scales``, or search for scales from there; None: from their prior centres."""
        limit = self._config.kinematics.maximum_lag_s
        goes_on = not (is_last or terms or self._departures)
        if scales is None or is_search:
            if not goes_on:
                return fit(strides, terms, scales, limit, self._departures)
            scales = most_probable_scales(strides, scales, limit)
            if scales is None:
                return None
            self._continued.forget()
        found = self._continued.fit(strides, scales) if goes_on else None
        return found or fit_given(strides, scales, terms, limit, self._departures)

    def _judge(self, t: float, found: RoadFit, conflict: str, withheld: Withheld) -> Estimate:
        lower, upper = posterior.box(self._config.prior)
        usual = [posterior.MAX_USUAL_MAGNITUDES * term.effect.usual_magnitude(found.road_load) for term in found.terms]
        lowest = [0.0 if term.effect.positive else -size for term, size in zip(found.terms, usual, strict=True)]
        bounds = np.append(lower, lowest), np.append(upper, usual)
        drive = RoadTarget.of(found, Belief.none(), *bounds)
        if reason := contradiction(self._config.prior, Judged(drive.free_mode, drive.free_sd)):
            return withheld(reason, status=Status.INVALID)
        belief = self._given + self._loads.carried_over(t, self._config.load)
        target = RoadTarget.of(found, belief, *bounds)
        judged = Judged(target.free_mode, target.free_sd)
        driven = found.strides
        coverage = self._gate.coverage(
            self._window.counts, np.maximum(judged.theta[:ROAD_LOAD], 0.0), driven.power[driven.power > 0]
        )
        selected = _selected(self._window.strides, found)
        if reason := self._gate.missing_coverage(coverage) or selected or _outside(judged, *bounds):
            return withheld(reason, coverage)
        if conflict:
            return withheld(conflict, coverage, remedy=EACH_LOAD)
        reasons = self._reasons(judged, found, *bounds)
        if "m" in reasons:
            return withheld(reasons["m"], coverage)
        if reason := _misfit(found, self._config.kinematics.maximum_lag_s):
            return withheld(reason, coverage, Status.INVALID)
        draws = posterior.sample(target, self._config, self._rng)
        if not draws.has_converged:
            return withheld(draws.complaint, coverage)
        return self._published(t, found, draws, coverage, reasons)

    def _unusual(self, found: RoadFit, scale: ScaleCheck) -> Doubt:
        """Doubt about the unit of the speed, by the size of the vehicle."""
        if scale.is_confirmed:
            return Doubt()
        A, C, m = found.theta[:ROAD_LOAD].tolist()
        sd = np.sqrt(np.maximum(np.diag(found.theta_covariance())[:ROAD_LOAD], 0.0))
        size = Size(A=A, C=C, mass=m, sd=sd, power=float(np.quantile(found.strides.power, PEAK_QUANTILE)))
        return unusual(size, scale.motion, scale.signal, self._config.prior.mass_kg)

    def _undetermined(self, found: RoadFit) -> str:
        """Reason why the drive does not determine the mass; empty where it does."""
        if not found.beta[0] > MIN_INVERSE_MASS:
            reason = "speed does not change with force: the drive is too uniform, or a signal is wrong"
            return reason + self._other_sign()
        if not found.determines_mass and self._config.prior.mass_belief_kg is None:
            return f"sd of mass is {100 * found.mass_sd:.0f} % of its value" + _advice("m", found)
        return ""

    def _other_sign(self) -> str:
        """Advice beside a doubt about the sign of the power; empty unless a battery current gives it."""
        if not is_electric(self._config.binding.keys()):
            return ""
        other = "negative" if self._config.vehicle.discharge_current == "positive" else "positive"
        return f'; if the battery current has the other sign, write [vehicle] discharge_current = "{other}"'

    def _reasons(self, judged: Judged, found: RoadFit, lower: Floats, upper: Floats) -> dict[str, str]:
        """Reason for each of PARAMETERS that is not known well enough."""
        reasons = {}
        for i, name in enumerate(PARAMETERS):
            value, sd = float(judged.theta[i]), float(judged.sd[i])
            reason = self._gate.obstacle_to_value(i, value, sd)
            near = value - EDGE_SDS * sd < lower[i] or value + EDGE_SDS * sd > upper[i]
            if not reason and near:
                reason = (
                    f"{NAMES[i]} {value:.4g} +- {sd:.2g} lies at the edge of its prior [{lower[i]:g}, {upper[i]:g}]"
                )
            if reason:
                reasons[name] = reason + _advice(name, found)
        return reasons

    def _published(
        self,
        t: float,
        found: RoadFit,
        draws: posterior.Posterior,
        coverage: Coverage,
        reasons: dict[str, str],
    ) -> Estimate:
        driven, window = found.strides, self._window
        power, residual = found.force * driven.speed, found.residual_power
        rms = float(np.sqrt(np.mean(residual**2)))
        trace = Trace(
            t=driven.t,
            v=driven.speed,
            a=driven.a,
            P=power,
            fitted=power - residual,
            density=driven.density,
            spacing=DURATION,
        )
        self.evidence = Evidence(
            trace=trace,
            posterior=draws,
            lag=found.lag,
            grid=window.grid,
            counts=window.counts,
            rms=rms,
            effective=float(len(driven)),
            coefficients=Coefficients(found.beta[:ROAD_LOAD], found.covariance[:ROAD_LOAD, :ROAD_LOAD]),
            fit=found,
        )
        marginals = {name: draws.marginal(i) for i, name in enumerate(PARAMETERS) if name not in reasons}
        road_load = draws.draws.reshape(-1, draws.draws.shape[2])[:, :ROAD_LOAD]
        return Estimate(
            t=t,
            status=Status.ESTIMATED,
            reason="",
            coverage=coverage,
            admitted=len(window),
            mass=marginals["m"],
            A=marginals.get("A"),
            C=marginals.get("C"),
            convergence=draws.convergence,
            rms=rms,
            effects={term.effect.name: draws.marginal(ROAD_LOAD + i) for i, term in enumerate(found.terms)},
            load=self._loads.show(Segment(road_load.mean(axis=0), np.cov(road_load.T), t)),
            withheld=reasons,
            road=_road(found),
            c_rr=draws.c_rr if "A" in marginals else None,
            air_density=trace.mean_density,
        )


def _has_changed(now: int, before: int, factor: float) -> bool:
    """Whether a number of rows has grown or shrunk by a factor."""
    return now >= factor * before or now <= before / factor


def _misfit(found: RoadFit, maximum_lag: float) -> str:
    """Reason why vehicle and road do not describe the strides; empty where they do."""
    a = found.strides.a
    explained = 1 - float(np.var(a - found.fitted)) / max(float(np.var(a)), 1e-12)
    if explained < MIN_EXPLAINED:
        share = 100 * max(explained, 0.0)
        return f"the model explains {share:.0f} % of the acceleration's variance: a wrong signal?"
    if found.beta[0] <= 0:
        return "speed does not change with force: a wrong signal?"
    if found.slope_sd > MAX_SLOPE_SD:
        return f"only slopes of {100 * found.slope_sd:.0f} % would explain the drive: a wrong signal?"
    if found.scales.values[[TORQUE, POWER]].max() > MAX_NOISE:
        return "force and acceleration are hardly correlated: a wrong signal?"
    if abs(found.lag) > (LONGEST_LAG if maximum_lag > LAGS.max() else USUAL_LAG):
        return f"power and speed are {found.lag:+.1f} s apart: check their time stamps"
    return ""


def _selected(strides: Strides, found: RoadFit) -> str:
    """Reason why the driven ones of all ``strides`` do not stand for the road; empty where they do."""
    driven = float(strides.rows[strides.known].sum() / strides.rows.sum())
    if driven >= MIN_DRIVEN or not (hills := _advice("m", found)):
        return ""
    return f"the vehicle pulls in {100 * driven:.0f} % of the driving only, where the slope lets it{hills}"


def _outside(judged: Judged, lower: Floats, upper: Floats) -> str:
    """Reason why a parameter is outside its box, which withholds all of them; empty where none is."""
    for i, name in enumerate(NAMES):
        value, sd = float(judged.theta[i]), float(judged.sd[i])
        if value + EDGE_SDS * sd < lower[i] or value - EDGE_SDS * sd > upper[i]:
            return f"{name} {value:.4g} +- {sd:.2g} lies outside its prior [{lower[i]:g}, {upper[i]:g}]"
    return ""


def _advice(name: str, found: RoadFit) -> str:
    """Obstacle to a parameter and remedy, as the end of a message."""
    if found.scales.readings or found.slope_sd < 2e-3:
        return ""
    hills = f"; hills with slopes of {100 * found.slope_sd:.1f} % that no signal shows are in the way"
    return hills + (", an altimeter would help" if name != "m" else ", a longer drive or an altimeter would help")


def _road(found: RoadFit) -> Road:
    """The road of an estimate."""
    falling = reversed_in(found)
    shown = tuple(name for name in found.scales.readings if name not in falling)
    return Road(
        slope_sd=found.slope_sd,
        length=found.slope_length,
        shown_by=shown,
        climbed=found.climbed if shown else None,
        contradicted=(*found.contradicted, *falling),
    )
