"""Judges the answers by the table of measures: each with its goal, its interval, and the drives that fall short."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from blind import answer
from blind.answer import Run
from blind.intervals import Estimate, Floats, bootstrap, calibration_error, share
from blind.truth import DETECTABLE, HIDDEN, Truth, key_of

LATE = 10.0  # s, the most that a log of 75 minutes may take
CLOSE = 0.03  # of the gap closed


@dataclass(frozen=True, slots=True)
class Case:
    """A drive with its truth and the answer given."""

    truth: Truth
    run: Run

    @property
    def plain(self) -> bool:
        """Whether nothing of the drive is allowed for unasked, so that there is something to find."""
        return not self.truth.shown

    @property
    def said(self) -> str:
        """The first name, or the verdict where none is named."""
        return self.run.named[0].name if self.run.named else self.run.verdict


@dataclass(frozen=True, slots=True)
class Measure:
    """One line of the table; ``failures`` are drives that a person may want to look at."""

    name: str
    goal: str
    estimate: Estimate
    unit: str = "%"
    failures: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Score:
    """All tables: the measures; the same by noise level and by effect; what was named for what."""

    measures: tuple[Measure, ...]
    by_noise: tuple[Measure, ...]
    by_effect: tuple[Measure, ...]
    confusion: dict[str, dict[str, int]]  # truth: what was said how often
    failed: tuple[str, ...]  # drives without an answer


def pair(truths: dict[str, Truth], runs: dict[str, Run]) -> list[Case]:
    """Truths with their answers; drives that were not diagnosed yet are left out."""
    return [Case(truth, runs[drive]) for drive, truth in truths.items() if drive in runs]


def score(cases: Sequence[Case]) -> Score:
    """Judge all cases."""
    return Score(
        measures=(*naming(cases), *honesty(cases), *shrinkage(cases), *parameters(cases), *cost(cases)),
        by_noise=tuple(_by_noise(cases)),
        by_effect=tuple(_by_effect(cases)),
        confusion=confusion(cases),
        failed=tuple(case.truth.drive for case in cases if case.run.answer is None),
    )


def _share(name: str, goal: str, cases: Iterable[Case], right: Callable[[Case], bool], lower: bool = False) -> Measure:
    """Share of cases for which ``right`` holds; ``lower``: holding is what should not happen."""
    judged = [(case.truth.drive, right(case)) for case in cases]
    failures = tuple(drive for drive, holds in judged if holds is lower)
    return Measure(name, goal, share(sum(holds for _, holds in judged), len(judged)), failures=failures)


def seen(case: Case) -> bool:
    """Whether an oracle sees every effect of the drive."""
    return case.plain and case.truth.log_bayes_factor > DETECTABLE


def right_first(case: Case) -> bool:
    """Whether the first name is right."""
    return answer.first_is_right(case.truth, case.run)


def claimed(case: Case) -> bool:
    """Whether the answer claims a gap with a cause, known or unknown."""
    return case.run.verdict in ("effect", "unknown effect")


def naming(cases: Sequence[Case]) -> list[Measure]:
    """Which effect: right names, false alarms, unknown ones, pairs."""
    kinds = {kind: [c for c in cases if c.truth.kind == kind] for kind in ("clean", "single", "pair", "outside")}
    middling = [c for c in kinds["single"] if c.plain and HIDDEN <= c.truth.log_bayes_factor <= DETECTABLE]
    hidden = [c for c in kinds["single"] if not c.plain or c.truth.log_bayes_factor < HIDDEN]
    clear = [c for c in kinds["single"] if seen(c)]
    outside = [c for c in kinds["outside"] if seen(c)]
    pairs = [c for c in kinds["pair"] if seen(c)]

    def wrong(case: Case) -> bool:
        return bool(answer.invented(case.truth, case.run))

    return [
        _share("named first, or its class: oracle > 10", ">= 95 %", clear, right_first),
        _share("... a wrong name, oracle > 10", "low", clear, wrong, lower=True),
        _share("named first, or its class: oracle 1..10", "-", middling, right_first),
        _share("... a wrong name, oracle 1..10", "low", middling, wrong, lower=True),
        _share("nothing claimed: oracle < 1, or allowed for unasked", ">= 98 %", hidden, lambda c: c.run.silent),
        _share("false alarm on a clean drive", "<= 1 %", kinds["clean"], claimed, lower=True),
        _share(
            "outside the catalogue: unknown effect", ">= 90 %", outside, lambda c: c.run.verdict == "unknown effect"
        ),
        _share("outside the catalogue: a wrong name", "<= 5 %", kinds["outside"], wrong, lower=True),
        _share("two effects: both named", ">= 85 %", pairs, lambda c: all(answer.found(c.truth, c.run))),
        _share("two effects: at least one named", ">= 98 %", pairs, lambda c: any(answer.found(c.truth, c.run))),
        _share("two effects: a wrong name besides", "low", pairs, wrong, lower=True),
    ]


def honesty(cases: Sequence[Case]) -> list[Measure]:
    """Probabilities: credible sets and calibration, on clean and single drives."""
    judged: list[Case] = []
    covered: dict[str, bool] = {}
    sizes, confidence, right = [], [], []
    for case in cases:
        chosen = answer.credible_set(case.run)
        if chosen is None or case.truth.kind == "pair":
            continue
        judged.append(case)
        covered[case.truth.drive] = any(_right(case, finding) for finding in chosen)
        if case.truth.kind == "single" and seen(case):
            sizes.append(len(chosen))
        confidence.append(min(max(chosen[0].probability or 0.0, 0.0), 1.0))
        right.append(float(_right(case, chosen[0])))
    return [
        _share("90 % credible set covers", "88..95 %", judged, lambda c: covered[c.truth.drive]),
        Measure("median size of the credible set, oracle > 10", "<= 2", bootstrap(_median, _array(sizes)), ""),
        Measure(
            "expected calibration error",
            "<= 0.05",
            bootstrap(calibration_error, _array(confidence), _array(right)),
            "",
        ),
    ]


def _right(case: Case, finding: answer.Finding) -> bool:
    """Whether a ranked candidate is the truth; "none" is, too, where nobody could see more."""
    truth = case.truth
    if finding.name == answer.NONE:
        return truth.log_bayes_factor < HIDDEN or truth.kind == "clean" or not case.plain
    if finding.name.startswith(answer.UNKNOWN):
        return truth.kind == "outside"
    return any(finding.means(effect.name) for effect in truth.effects)


def shrinkage(cases: Sequence[Case]) -> list[Measure]:
    """How far the gap shrinks against the oracle's share, and when bounded effects act."""
    promised = []  # case, error of the share
    inside: dict[str, bool] = {}  # whether the interval of an only effect holds the oracle's share
    located = []
    for case in cases:
        truth, run = case.truth, case.run
        if truth.kind in ("clean", "outside") or not case.plain or not run.named or answer.invented(truth, run):
            continue
        hits = [e for e, hit in zip(truth.effects, answer.found(truth, run), strict=True) if hit]
        closed = [finding.gap_closed for finding in run.named]
        fractions = [c.fraction for c in closed if c is not None and c.fraction is not None]
        if len(fractions) == len(run.named) and truth.stratum == "oracle > 10":
            oracle = truth.gap_closed[key_of(effect.world for effect in hits)]
            # Each effect closes its share of what those before it have left.
            promised.append((case, 1.0 - float(np.prod([1.0 - x for x in fractions])) - oracle))
            if len(fractions) == 1:
                only = closed[0]
                inside[truth.drive] = only.q05 <= oracle <= only.q95
        for effect in hits:
            if effect.spans:
                finding = next(f for f in run.named if f.means(effect.name))
                located.append(answer.overlap(finding.span, effect.spans, truth.driven))
    errors = {case.truth.drive: abs(error) <= CLOSE for case, error in promised}
    judged = [case for case, _ in promised]
    single = [case for case in judged if case.truth.drive in inside]
    return [
        _share("gap closed within 3 points of the oracle", ">= 95 %", judged, lambda c: errors[c.truth.drive]),
        _share("its 90 % interval covers the oracle", "85..95 %", single, lambda c: inside[c.truth.drive]),
        Measure(
            "median error of the gap closed",
            "small",
            bootstrap(_median, 100 * _array([error for _, error in promised])),
            "points",
        ),
        Measure("localisation of bounded effects: median IoU", ">= 0.9", bootstrap(_median, _array(located)), ""),
    ]


def parameters(cases: Sequence[Case]) -> list[Measure]:
    """Errors of A, C, m where the answer is right: all effects named on drives with some, nothing on clean ones."""
    lines = []
    good = [c for c in cases if c.truth.kind != "outside" and c.plain and c.run.answer is not None]
    good = [c for c in good if not answer.invented(c.truth, c.run) and all(answer.found(c.truth, c.run))]
    for key, label in (("mass_kg", "mass"), ("A_N", "A"), ("C_N_s2_m2", "C")):
        errors = []
        for case in good:
            final = case.run.answer.parameters.final if case.run.answer is not None else None
            value = None if final is None else final.get(key)
            if value is not None:
                errors.append(value / case.truth.parameters[key] - 1.0)
        x = 100 * _array(errors)
        lines.append(Measure(f"{label} with the right effects: median error", "0 %", bootstrap(_median, x), "per cent"))
        lines.append(Measure(f"{label} with the right effects: rms error", "small", bootstrap(_rms, x), "per cent"))
    return lines


def cost(cases: Sequence[Case]) -> list[Measure]:
    """Time and memory of a diagnosis."""
    seconds = _array([case.run.processor_seconds for case in cases])
    peak = _array([case.run.peak_MB for case in cases])
    slow = tuple(case.truth.drive for case in cases if case.run.processor_seconds > LATE)
    return [
        Measure("processor time for a log, median", "<= 10 s", bootstrap(_median, seconds), "s", slow),
        Measure("processor time for a log, 95 % quantile", "<= 10 s", bootstrap(_high, seconds), "s"),
        Measure("peak memory, largest", "-", bootstrap(_largest, peak[np.isfinite(peak)]), "MB"),
    ]


def _by_noise(cases: Sequence[Case]) -> Iterable[Measure]:
    levels = sorted({(c.truth.speed_noise, c.truth.torque_resolution) for c in cases})
    groups = {f"speed noise {1e3 * v:g} mm/s": {x for x in levels if x[0] == v} for v, _ in levels}
    groups |= {f"torque resolution {100 * T:g} %": {x for x in levels if x[1] == T} for _, T in levels}
    for name, members in groups.items():
        here = [c for c in cases if (c.truth.speed_noise, c.truth.torque_resolution) in members]
        clean = [c for c in here if c.truth.kind == "clean"]
        single = [c for c in here if c.truth.kind == "single" and seen(c)]
        yield _share(f"{name}: false alarms", "<= 1 %", clean, claimed, lower=True)
        yield _share(f"{name}: named first", ">= 95 %", single, right_first)


def _by_effect(cases: Sequence[Case]) -> Iterable[Measure]:
    single = [c for c in cases if c.truth.kind == "single" and seen(c)]
    for name in sorted({c.truth.effects[0].world for c in single}):
        these = [c for c in single if c.truth.effects[0].world == name]
        yield _share(name, ">= 95 %", these, right_first)


def confusion(cases: Sequence[Case]) -> dict[str, dict[str, int]]:
    """What was said first, by what was true; effects that cannot be seen have rows of their own."""
    rows: dict[str, Counter[str]] = {}
    for case in cases:
        truth = case.truth
        name = " + ".join(sorted(effect.world for effect in truth.effects)) or "clean"
        if truth.kind == "pair":
            name = "pair: " + name
        elif truth.shown:
            name += " (allowed for)"
        elif truth.effects and truth.stratum != "oracle > 10":
            name += f" ({truth.stratum})"
        said = "+".join(f.name for f in case.run.named) if truth.kind == "pair" and case.run.named else case.said
        rows.setdefault(name, Counter())[said] += 1
    return {name: dict(said.most_common()) for name, said in sorted(rows.items())}


def _array(values: Sequence[float]) -> Floats:
    return np.array(values, dtype=np.float64)


def _median(x: Floats) -> float:
    return float(np.median(x))


def _rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(x**2)))


def _high(x: Floats) -> float:
    return float(np.quantile(x, 0.95))


def _largest(x: Floats) -> float:
    return float(x.max())
