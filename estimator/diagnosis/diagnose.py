"""The diagnosis: where the gap lies, which effect causes it, how far it shrinks, and what is left."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.diagnosis import isolability as iso
from estimator.diagnosis.candidates import Candidate, assess
from estimator.diagnosis.evidence import parameter_sd
from estimator.diagnosis.model import FEWEST, Model, fit, select
from estimator.diagnosis.processes import UNMEASURED_GRADE, Leftover, grains_of
from estimator.diagnosis.record import Record
from estimator.diagnosis.result import (
    Diagnosis,
    Finding,
    GapClosed,
    Invisible,
    Magnitude,
    NotTestable,
    Shift,
    Traces,
    Verdict,
)
from estimator.diagnosis.search import (
    AHEAD,
    EVIDENT,
    NAMED,
    UNEXPLAINED,
    Drive,
    Found,
    Joint,
    Search,
    grade_sd,
    hidden_grade,
    pooled,
    probabilities,
    same_class,
    search,
)
from estimator.diagnosis.shrinkage import gap_closed, held_out
from estimator.diagnosis.where import gap_map, places
from estimator.effects import BY_NAME, CATALOGUE, Effect, Timing
from estimator.estimation.columns import PLAIN, Term, best_terms, columns
from estimator.estimation.moments import block_means
from estimator.signals import Floats, Quantity

SOMETHING = 3.0  # log Bayes factor below which there is no gap to speak of
CLOSE = 10.0  # log Bayes factor by which a process may beat effects that leave nothing, and yet be them
LEFT = 0.25  # of the evidence of nameless processes that effects may leave if they are to be its name
SECOND = 10  # samples
ORDINARY_LAG = 0.12  # s, between control units
CORRELATED = 4.0  # residuals of 2 s that count as one
SHORTEST = 300.0  # s of admitted driving


def diagnose(
    records: Sequence[Record],
    given: tuple[Effect, ...],
    rng: np.random.Generator,
    effects: Sequence[Effect] = CATALOGUE,
) -> Diagnosis:
    """Diagnose one drive, or several of one vehicle; ``given`` effects are part of the model from the start."""
    plain: list[Drive] = []
    reason = "there is no driving in it"
    for record in records:
        drive = _start(record, given)
        if isinstance(drive, Drive):
            plain.append(drive)
        else:
            reason = drive
    missing = tuple(iso.not_testable(effects, frozenset().union(*(record.known for record in records))))
    if not plain:
        return Diagnosis(Verdict.CANNOT_TELL, f"Cannot tell: {reason}.", not_testable=missing)
    result = search(tuple(plain), effects)
    return _Report(result, tuple(plain), effects, rng).diagnosis(missing)


def _start(record: Record, given: tuple[Effect, ...]) -> Drive | str:
    """The plain model on one drive, or why there is none."""
    samples = record.samples
    if len(samples) < FEWEST:
        common = record.rejected.most_common(1)
        return "less than a minute of driving can be used" + (f"; most is: {common[0][0]}" if common else "")
    if len(samples) < SHORTEST * SECOND:
        return f"only {len(samples) / SECOND / 60:.1f} minutes of driving can be used; it takes 5 at least"
    for effect in given:
        if not effect.streaming_shapes(record.known):
            return f"the effect {effect.name} needs {' or '.join(r.value for r in effect.wanted)}, which the bus lacks"
    A, C, m = 1e3, 1.0, 1e4  # of no weight: only the best of several shapes is looked for
    terms = best_terms(given, samples, np.array([A, C, m]))
    kept = select(samples, terms)
    model = None if kept is None else fit(samples[kept], terms)
    if model is None or len(model.samples) < SHORTEST * SECOND:
        return "speed and acceleration vary too little, or power is not positive, so A, C and m cannot be told apart"
    return Drive(record, model)


class _Report:
    """Numbers of a finished search."""

    def __init__(self, result: Search, plain: tuple[Drive, ...], effects: Sequence[Effect], rng: np.random.Generator):
        self.result, self.plain, self.effects, self.rng = result, plain, effects, rng
        self.final = result.drives
        self.grade = hidden_grade(result.ranking, result.at_first, plain)
        self.longest = max(range(len(plain)), key=lambda i: len(plain[i].model.samples))
        best = result.at_last[0]
        self.left_variance = best.variance if best.log_bayes_factor > SOMETHING else 0.0
        # Every step is judged on the samples that the final model uses.
        self.steps = [pooled(drives, self.final) for drives in (*(f.before for f in result.chosen), self.final)]
        # What a process could still be hiding in what is taken for noise.
        self.doubt = min(best.variance / self.steps[-1].mean_square, 0.5)
        self.floor = max(self.steps[-1].mean_square - self.left_variance, 0.05 * self.steps[-1].mean_square)

    def _lag(self) -> Finding | None:
        """A lag between power and speed that no sensor's ordinary delay explains; the alignment has taken it out."""
        drive = self.final[self.longest]
        base, s = drive.model.base, drive.model.samples
        lag = drive.record.lag + float(base.theta[PLAIN - 1])
        sd = parameter_sd(base, PLAIN - 1)
        if abs(lag) - ORDINARY_LAG < 4 * sd:
            return None
        # As if nobody had aligned: the power of lag seconds ago, to first order, and no column for its rate.
        late = replace(s, P=s.P - lag * s.dP)
        before = held_out(late, drive.model.terms, drive.model.road_load, lagged=False)
        after = self.steps[-1] if len(self.final) == 1 else held_out(s, drive.model.terms, drive.model.road_load)
        evidence = len(before.squares) / 2 * float(np.log(before.mean_square / after.mean_square)) / CORRELATED
        if evidence < NAMED:
            return None
        plain = fit(late, drive.model.terms)
        effect = BY_NAME["time_lag" if lag > 0 else "speed_filter"]
        return Finding(
            effect.name,
            probabilities([evidence])[0],
            evidence,
            effect.equivalent,
            Magnitude(effect.symbol, lag, sd, effect.unit),
            gap_closed(before, after, min(self.floor, after.mean_square), self.doubt, self.rng),
            before.rms,
            after.rms,
            None if plain is None else _difference(plain, drive.model),
            (),
            "taken out by the alignment",
        )

    def diagnosis(self, missing: tuple[NotTestable, ...]) -> Diagnosis:
        """Put together."""
        verdict, grade = self._verdict()
        lag = self._lag()
        if lag is not None and verdict in (Verdict.NO_GAP, Verdict.CANNOT_TELL) and not self.result.chosen:
            verdict = Verdict.EFFECT
        findings = tuple(self._finding(i, found) for i, found in enumerate(self.result.chosen))
        left = self.result.at_last[0]
        if grade and self.grade is not None:
            findings = (*findings, self._grade(self.grade))
        if lag is not None:
            findings = (*findings, lag)
        named = findings if verdict in (Verdict.EFFECT, Verdict.CANNOT_TELL) else ()
        before, after = self.plain[self.longest].model, self.final[self.longest].model
        candidates = [c for joint in self.result.ranking if (c := joint.each[self.longest]) is not None]
        unseen = tuple(
            iso.invisible(self.effects, self._last_candidates(), after, self.plain[self.longest].record.known)
        )
        remaining = Verdict.UNKNOWN if left.log_bayes_factor > UNEXPLAINED else Verdict.NO_GAP
        remaining = Verdict.CANNOT_TELL if grade else remaining
        return Diagnosis(
            verdict,
            self._reason(verdict, named, unseen),
            named,
            self._candidates(lag),
            remaining,
            None if grade else left.log_bayes_factor,
            float(np.sqrt(self.floor)),
            self.steps[0].rms,
            self.steps[-1].rms,
            _shift(before),
            _shift(after),
            _deviation(after),
            tuple(places(before)),
            iso.isolability(candidates, before),
            missing,
            unseen,
            self._advice(verdict, named),
            _configuration(named, self.plain[self.longest].model.terms),
            gap_map(before, after),
            _traces(self.plain, self.final),
        )

    def _last_candidates(self) -> list[Candidate]:
        """What the longest drive says of every effect that the final model does not have."""
        drive = self.final[self.longest]
        return assess(drive.model, grains_of(drive.model), self.effects, drive.record.known, drive.rest)

    def _verdict(self) -> tuple[Verdict, bool]:
        """The verdict, and whether an unmeasured grade is part of it."""
        chosen, left = self.result.chosen, self.result.at_last[0].log_bayes_factor
        if self.grade is not None:
            return Verdict.EFFECT, True
        if not chosen:
            if left > EVIDENT:
                return Verdict.UNKNOWN, False
            best = self.result.ranking[0].log_bayes_factor if self.result.ranking else 0.0
            return (Verdict.CANNOT_TELL if best > SOMETHING else Verdict.NO_GAP), False
        at_first = self.result.at_first[0].log_bayes_factor
        first = self.result.ranking[0].log_bayes_factor
        total = max(first, sum(found.joint.log_bayes_factor for found in chosen))
        outdone = first < at_first + AHEAD or left > LEFT * max(at_first, total)
        # What a poor altimeter leaves of the hills goes with the place.
        place = next(other for other in self.result.at_last if other.name == UNMEASURED_GRADE)
        hills = any(f.joint.effect.is_gravity for f in chosen) and place.log_bayes_factor > left - NAMED
        if not hills and (total < at_first - CLOSE or (left > UNEXPLAINED and outdone)):
            return Verdict.UNKNOWN, False
        return (Verdict.CANNOT_TELL if self._ties(chosen[0]) else Verdict.EFFECT), False

    def _close(self, found: Found) -> list[Joint]:
        """Effects that come within AHEAD of one that was chosen."""
        limit = found.joint.log_bayes_factor - AHEAD
        return [joint for joint in found.ranking if joint is not found.joint and joint.log_bayes_factor > limit]

    def _ties(self, found: Found) -> list[str]:
        """Those of another class: another drive could tell."""
        return [joint.name for joint in self._close(found) if not same_class(found.joint, joint)]

    def _alike(self, found: Found) -> list[str]:
        """Those of its class."""
        alike = {joint.name for joint in self._close(found) if same_class(found.joint, joint)}
        return sorted(alike | set(found.joint.effect.equivalent))

    def _finding(self, i: int, found: Found) -> Finding:
        joint, before, after = found.joint, self.steps[i], self.steps[i + 1]
        which, candidate = joint.best
        final = self.final[which].model
        term = next((t for t in final.terms if t.effect.name == joint.name), candidate.term)
        earlier = self.final[which].without(joint.name).model
        spans = term.spans or ()
        return Finding(
            joint.name,
            self._probability(found),
            joint.log_bayes_factor,
            (*self._alike(found), *self._ties(found)),
            _magnitude(final, candidate),
            gap_closed(before, after, self.floor, self.doubt, self.rng),
            before.rms,
            after.rms,
            _difference(earlier, final),
            self._clock(which, spans),
            _detail(term),
        )

    def _clock(self, which: int, spans: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        start = self.plain[which].record.start
        return tuple((a - start, b - start) for a, b in spans)

    def _probability(self, found: Found) -> float:
        rivals = [joint.log_bayes_factor for joint in found.ranking if joint is not found.joint]
        if len(self.result.chosen) == 1:
            rivals.append(self.result.at_first[0].log_bayes_factor)
        return probabilities([found.joint.log_bayes_factor, *rivals])[0]

    def _grade(self, left: Leftover) -> Finding:
        """A grade that no signal shows, as far as it can be foretold on this road."""
        others = [joint.log_bayes_factor for joint in self.result.ranking]
        before = self.steps[-1]
        model = self.final[self.longest].model
        sd = grade_sd(left, self.plain)
        after = float(np.sqrt(self.floor))
        closed = 1.0 if before.mean_square > self.floor else 0.0
        return Finding(
            "grade",
            probabilities([left.log_bayes_factor, *others])[0],
            left.log_bayes_factor,
            (),
            Magnitude("sd of the grade", sd, sd / np.sqrt(2 * max(len(model.samples) / SECOND / 30, 1)), "1"),
            GapClosed(closed, float("nan"), float("nan")),
            before.rms,
            after,
            None,
            (),
            "goes with the place; no signal on the bus shows it",
        )

    def _candidates(self, lag: Finding | None) -> tuple[Finding, ...]:
        """The whole ranking against the plain model."""
        ranking = self.result.ranking
        values = [joint.log_bayes_factor for joint in ranking]
        others = [self.result.at_first[0].log_bayes_factor, *([] if lag is None else [lag.log_bayes_factor])]
        shares = probabilities([*values, *others])
        rms = self.steps[0].rms
        listed = []
        for joint, share in zip(ranking, shares, strict=False):
            which, candidate = joint.best
            alike = tuple(sorted(other.name for other in ranking if other is not joint and same_class(joint, other)))
            term = candidate.term
            size = Magnitude(term.effect.symbol, candidate.value, candidate.sd, term.effect.unit)
            spans = self._clock(which, term.spans or ())
            listed.append(
                Finding(
                    joint.name, share, joint.log_bayes_factor, alike, size, None, rms, rms, None, spans, _detail(term)
                )
            )
        process = self.result.at_first[0]
        size = Magnitude("rms", float(np.sqrt(process.variance)), float("nan"), "W")
        value, share = process.log_bayes_factor, shares[len(ranking)]
        name = Verdict.UNKNOWN.value if self.grade is None else "grade"
        nameless = Finding(name, share, value, (), size, None, rms, rms, None, (), process.name)
        lags = [] if lag is None else [replace(lag, probability=shares[len(ranking) + 1])]
        return tuple(sorted([*listed, nameless, *lags], key=lambda finding: -finding.log_bayes_factor))

    def _reason(self, verdict: Verdict, named: tuple[Finding, ...], unseen: tuple[Invisible, ...]) -> str:
        base, final = self.steps[0].rms / 1e3, self.steps[-1].rms / 1e3
        left = self.result.at_last[0]
        if verdict is Verdict.NO_GAP:
            hidden = f"; too small to see here: {', '.join(i.name for i in unseen)}" if unseen else ""
            return f"The road load describes this drive to {base:.1f} kW, and nothing systematic is left{hidden}."
        if verdict is Verdict.UNKNOWN:
            return (
                f"Something is missing that no known effect explains: {left.name}, "
                f"{np.sqrt(left.variance) / 1e3:.1f} kW of {base:.1f} kW."
            )
        if verdict is Verdict.CANNOT_TELL:
            if named:
                rivals = " or ".join([named[0].name, *named[0].equivalent])
                return f"The drive shows {rivals}, and cannot tell which."
            best = self.result.ranking[0]
            doubt = "too weak on this drive to be sure"
            if best.log_bayes_factor > NAMED:
                doubt = "but it does not foretell stretches of the drive that were kept from the fit"
            return f"There may be {best.name}, {doubt}."
        if self.grade is not None:
            sd = 100 * named[0].magnitude.value
            seen = f"A force goes with the place like a grade of {sd:.1f} % sd, and no signal on the bus shows it"
            return f"{seen}; with one, the residual could fall from {base:.1f} to {self.floor**0.5 / 1e3:.1f} kW."
        sentences = [f"{f.name} ({f.magnitude.name} {_size(f.magnitude)})" for f in named]
        if not self.result.chosen:
            base = named[0].rms_before / 1e3
        return f"With {' and '.join(sentences)} in the model the residual falls from {base:.1f} to {final:.1f} kW."

    def _advice(self, verdict: Verdict, named: tuple[Finding, ...]) -> tuple[str, ...]:
        by_name = {effect.name: effect for effect in self.effects}
        unsure: list[str] = []
        if verdict is Verdict.CANNOT_TELL:
            unsure += [named[0].name, *named[0].equivalent] if named else [self.result.ranking[0].name]
        elif verdict is Verdict.EFFECT:
            unsure += [other for finding in named for other in finding.equivalent]
            unsure += [f.name for f in named if f.name == "grade" and f.magnitude.name == "sd of the grade"]
        return tuple(f"{name}: {by_name[name].breaks}" for name in dict.fromkeys(unsure) if name in by_name)


def _shift(model: Model) -> Shift:
    A, C, m = model.road_load.tolist()
    return Shift(mass=m, A=A, C=C)


def _deviation(model: Model) -> Shift:
    A, C, m = (parameter_sd(model.base, i) for i in range(3))
    return Shift(mass=m, A=A, C=C)


def _difference(before: Model, after: Model) -> Shift:
    A, C, m = (after.road_load - before.road_load).tolist()
    return Shift(mass=m, A=A, C=C)


def _magnitude(model: Model, candidate: Candidate) -> Magnitude:
    """As the final model has it, with the uncertainty with which it was first found."""
    effect = candidate.term.effect
    values = {term.effect.name: value for term, value in zip(model.terms, model.magnitudes, strict=True)}
    return Magnitude(effect.symbol, values.get(effect.name, candidate.value), candidate.sd, effect.unit)


def _size(magnitude: Magnitude) -> str:
    return f"{magnitude.value:.3g} ± {magnitude.sd:.1g} {magnitude.unit}".replace(" 1/h", "/h").removesuffix(" 1")


def _detail(term: Term) -> str:
    """The shape found, in words."""
    if isinstance(term.shape, Quantity):
        return term.shape.value
    if term.effect.name == "headwind":
        return f"from {np.degrees(term.shape[0]):.0f} deg"
    if term.effect.name == "warm_up":
        return f"time constant {term.shape / 60:.0f} min"
    if term.effect.timing is Timing.SWITCHING and term.spans:
        return f"{len(term.spans)} times on"
    return ""


def _configuration(named: tuple[Finding, ...], given: tuple[Term, ...]) -> str:
    """The line that adds to the streaming model what it can take, beside what it has."""
    found = [f.name for f in named if f.name in BY_NAME and f.magnitude.name == BY_NAME[f.name].symbol and not f.span]
    names = dict.fromkeys([*(term.effect.name for term in given), *(n for n in found if BY_NAME[n].streams)])
    return f"effects = [{', '.join(f'{chr(34)}{name}{chr(34)}' for name in names)}]" if found and names else ""


def _traces(plain: tuple[Drive, ...], final: tuple[Drive, ...]) -> Traces:
    """Means over a second."""
    parts: list[list[Floats]] = [[] for _ in range(6)]
    for before, after in zip(plain, final, strict=True):
        samples = after.model.samples
        base = held_in(before.model, after.model)
        start = before.record.start
        arrays = (
            samples.t - start,
            samples.context[Quantity.DISTANCE],
            samples.v,
            samples.P,
            base,
            samples.P - after.model.base.residual,
        )
        for part, array in zip(parts, arrays, strict=True):
            part.append(block_means(array, SECOND))
    return Traces(*(np.concatenate(part) for part in parts))


def held_in(model: Model, on: Model) -> Floats:
    """Power [W] that ``model`` predicts for the samples of another."""
    X, _ = columns(on.samples, model.terms, model.road_load)
    predicted: Floats = X @ model.base.theta
    return predicted
