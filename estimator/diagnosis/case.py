"""Check whether a drive can be diagnosed, and hold it with the effects that the configuration gives."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from estimator.components.drive_state import DriveState
from estimator.components.plain_model import PlainModel
from estimator.components.term import Frame, term_of
from estimator.estimation.gate import wrong_sign_of, wrong_unit_of
from estimator.estimation.road_fit import RoadFit, fit, search_of
from estimator.estimation.road_signals import constant, contradicted
from estimator.estimation.scales import RoadScales
from estimator.estimation.shapes import fitted_with_shapes, is_free, nearer_shapes, terms_of
from estimator.model.effect_term import EffectTerm
from estimator.model.effects import Effect, obstacle
from estimator.preparation.drive import Drive

UNIFORM = "speed and acceleration vary too little, or power is not positive, so A, C and m cannot be told apart"
MIN_MINUTES = 5.0  # [min] of strides with a known force: shorter drives seldom determine A, C and m


@dataclass(frozen=True)
class Case:
    """A ``drive`` and the effects ``given`` by the configuration.

    ``terms`` hold the given effects that have a column; the slope of the road is a state and has none. Signals of the
    road that never change, or are ``contradicted`` by the others, have no values in the drive's strides.
    """

    drive: Drive
    given: tuple[Effect, ...]
    terms: tuple[EffectTerm, ...]
    contradicted: tuple[str, ...] = ()

    @property
    def is_road_given(self) -> bool:
        """True if the configuration gives an effect of gravity, so that the road is a state from the start."""
        return any(effect.is_gravity for effect in self.given)

    @classmethod
    def of(cls, drive: Drive, given: Sequence[Effect]) -> "Case | str":
        """Case of a drive, or the reason (str) why the drive cannot be diagnosed."""
        minutes = drive.minutes_known
        if minutes < MIN_MINUTES:
            common = drive.rejected.most_common(1)
            amount = f"only {minutes:.1f} minutes" if minutes >= 1 else "less than a minute"
            most = f"; most is: {common[0][0]}" if common and minutes < 1 else ""
            return f"{amount} of driving can be used; it takes {MIN_MINUTES:.0f} at least{most}"
        if reason := obstacle(tuple(given), drive.known_quantities):
            return reason
        driven = drive.strides[drive.strides.known]
        lightest, force = drive.config.prior.mass_kg[0], driven.power / driven.speed
        if reason := wrong_sign_of(driven.power, driven.a) or wrong_unit_of(force, driven.a, lightest):
            return reason
        without_change = constant(drive.strides)
        others = (*without_change, *contradicted(drive.strides.without(without_change), search_of))
        drive = replace(drive, strides=drive.strides.without(others))
        moving = [effect for effect in given if not (effect.is_gravity or effect.is_absorbed)]
        terms = _terms(drive, moving) if moving else ()
        return cls(drive, tuple(given), terms, others)

    def beside(self, found: DriveState) -> "Case":
        """Copy whose given terms have the shapes with most evidence beside all effects ``found``."""
        if not any(is_free(term) for term in self.terms):
            return self
        nearer = nearer_shapes(found.strides, found.fit)[: len(self.terms)]
        return replace(
            self, terms=tuple(replace(old, shape=new.shape) for old, new in zip(self.terms, nearer, strict=True))
        )

    def state(self, is_level: bool) -> DriveState | None:
        """Fit of the drive with the given terms, where the search starts; None if it does not determine A, C and m.

        ``is_level``: the road has no slope.
        """
        state = DriveState.of(self.drive.strides, self.drive.rests, is_level)
        if state is None or not PlainModel(state.fit).is_determined:
            return None
        frame = Frame.of(state.fit)
        return (
            state.with_terms(tuple(term_of(frame, effect_term) for effect_term in self.terms)) if self.terms else state
        )


def _terms(drive: Drive, effects: Sequence[Effect]) -> tuple[EffectTerm, ...]:
    """Terms of ``effects``; a shape that no signal shows is the one with most evidence."""
    strides = drive.strides

    def fitted(terms: tuple[EffectTerm, ...], start: RoadScales | None) -> RoadFit | None:
        return fit(strides, terms, start)

    terms = terms_of(strides, effects, lambda: fitted((), None))
    shaped = fitted_with_shapes(strides, terms, fitted)
    return terms if shaped is None else shaped.terms
