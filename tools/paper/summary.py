"""Figures of the reproduction as records, a list for each of the paper's tables and figures.

Parameters A, C, m are in the paper's units, and errors are relative. A pair is a value and its standard deviation;
three numbers are the median and the ends of a 90 % interval.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from estimator.model.road_load import power
from estimator.signals import Floats
from paper.cycles import Cycle
from paper.estimation import Availability, Estimate
from paper.experiments import means, truth_of
from paper.hierarchy import HierarchicalFit
from paper.printed import PRINTED
from paper.studies import COPIES, NOISE_LEVELS, CoverageStudy, DurationStudy, NoiseStudy
from paper.table_five import Match, Processing, Units, angle
from paper.vehicle_posterior import BETWEEN_PRIORS, CRUISE, offset_response
from paper.vehicles import DUMMY, HP, NAMES, NOMINAL, PAPER_UNITS, TO_SI

PARAMETERS = [f"{name} [{unit}]" for name, unit in zip(NAMES, PAPER_UNITS, strict=True)]
MAX_RMS = 0.5  # rms in log10 of the combinations of units that are listed
NATURAL = Units(mass="slug", power="lbf ft/s", factor="JᵀJ")
LINEAR_UP_TO = 10 * HP  # W, noise up to which the errors are fitted by a power of it
SHOWN_BIAS = 20 * HP  # W
Record = dict[str, Any]


def parameters(theta: Floats, sd: Floats | None = None) -> Record:
    """A, C, m (3,) by name and unit, with their sd where given."""
    values = theta.tolist() if sd is None else np.column_stack([theta, sd]).tolist()
    return dict(zip(PARAMETERS, values, strict=True))


def errors(theta: Floats) -> Record:
    """Relative errors of A, C, m (3,) by name."""
    return {f"error of {name}": float(x) for name, x in zip(NAMES, theta, strict=True)}


def interval(draws: Floats) -> list[float]:
    """Median, 5 % and 95 % quantile."""
    low, middle, high = np.quantile(draws, [0.05, 0.5, 0.95]).tolist()
    return [middle, low, high]


def cycles(given: Mapping[str, Cycle], reach: Availability) -> list[Record]:
    """The drive cycles; the peak is the power that the nominal truck needs to follow one exactly."""
    return [
        {
            "cycle": name,
            "duration [s]": c.duration,
            "distance [mi]": c.miles,
            "peak [kW]": float(power(c.v, c.a, NOMINAL).max()) / 1e3,
            "coverage": reach.coverage(c),
        }
        for name, c in given.items()
    ]


def dummy(cases: Mapping[str, list[tuple[Floats, Floats]]]) -> list[Record]:
    """The dummy case without noise: estimates, and the largest errors of two schedules."""
    rows = []
    for name, ((mean, _), (frozen_mean, frozen_sd)) in cases.items():
        rows.append(
            {
                "cycle": name,
                **parameters(mean / TO_SI),
                "largest error": float(np.abs(mean / DUMMY - 1).max()),
                "sigma frozen to iteration 5000": float(np.abs(frozen_mean / DUMMY - 1).max()),
                "its largest sd": float((frozen_sd / DUMMY).max()),
            }
        )
    return rows


def table_one(runs: Mapping[str, Sequence[Estimate]]) -> list[Record]:
    """Mean and sd over the runs of each cycle: printed, from the printed runs, and from simulated ones."""
    rows = [{"estimates": "nominal", **parameters(NOMINAL / TO_SI)}]
    for name, printed in PRINTED.items():
        here = means(list(runs[name]))
        rows.append({"estimates": f"{name}, Table 1", **parameters(printed.mean, printed.sd)})
        for label, values in ((f"{name}, from Table {printed.table}", printed.estimates), (f"{name}, here", here)):
            rows.append({"estimates": label, **parameters(values.mean(axis=0), values.std(axis=0, ddof=1))})
    return rows


def run_row(name: str, index: int, found: Estimate) -> Record:
    """One run of Tables 2 to 4 beside the estimate of a simulated one with the same rms."""
    printed = PRINTED[name]
    here = {f"{key}, here": value for key, value in parameters(found.mean / TO_SI, found.sd / TO_SI).items()}
    rms = {"rms [hp]": float(printed.rms[index]), "rms [hp], here": found.sigma / HP}
    return {"run": f"{name} {index + 1}", **parameters(printed.estimates[index]), **here, **rms}


def chains(runs: Mapping[str, Sequence[Estimate]]) -> list[Record]:
    """What the simulated runs of a cycle have in common: chains, and intervals that hold the truth."""
    return [
        {
            "cycle": name,
            "deviation of chains": float(np.mean([run.chain_deviation for run in repeated])),
            "largest R-hat": max(run.r_hat for run in repeated),
            "90 % intervals that hold": int(np.sum([run.holds(truth_of(name)) for run in repeated])),
            "of": 3 * len(repeated),
        }
        for name, repeated in runs.items()
    ]


def scatter(given: Mapping[str, Mapping[str, Floats]]) -> list[Record]:
    """Sd between runs beside what white noise of the printed rms gives."""
    rows = [(name, label, values) for name, spreads in given.items() for label, values in spreads.items()]
    return [{"cycle": name, "spread": label, **parameters(values)} for name, label, values in rows]


def levene(printed: Sequence[tuple[float, float]], here: Sequence[tuple[float, float]]) -> list[Record]:
    """Levene's test between cycles: W, and p."""
    rows = {"printed runs": printed, "simulated runs": here}
    return [
        {
            "runs": label,
            **{f"W of {name}": statistic for name, (statistic, _) in zip(NAMES, tests, strict=True)},
            **{f"p of {name}": p for name, (_, p) in zip(NAMES, tests, strict=True)},
        }
        for label, tests in rows.items()
    ]


def match_of(matches: Sequence[Match], units: Units, processing: Processing) -> Match:
    """The combination of these choices."""
    return next(m for m in matches if m.units == units and m.processing == processing)


def units(matches: Sequence[Match]) -> list[Record]:
    """The nearest combination for each choice of units, up to MAX_RMS."""
    nearest: dict[Units, Match] = {}
    for match in matches:
        nearest.setdefault(match.units, match)
    return [
        {
            "m in": u.mass,
            "P in": u.power,
            "matrix": u.factor,
            "rms of log10": m.rms,
            "largest": float(np.abs(m.differences).max()),
            "with": _words(m.processing),
        }
        for u, m in nearest.items()
        if m.rms < MAX_RMS or u.mass in ("lbf/(mph/s)", "lbm")
    ]


def choices(matches: Sequence[Match]) -> list[Record]:
    """One choice of the processing at a time, with m in slug and P in lbf ft/s: largest differences of log10."""
    given = [Processing(), Processing(parameters="nominal"), Processing(selection="all")]
    given += [Processing(derivative=d) for d in ("forward", "backward")]
    given += [Processing(trace=t) for t in ("mean of 5 s", "at most 250 kW", "at most 200 kW", "at most 150 kW")]
    given += [matches[0].processing]
    rows = []
    for choice in given:
        match = match_of(matches, NATURAL, choice)
        parts = zip(("log λ1", "log λ2", "log λ3", "log tan angle"), np.abs(match.differences).max(axis=0), strict=True)
        rows.append({"choice": _words(choice), "rms": match.rms, **{name: float(x) for name, x in parts}})
    return rows


def table_five(matches: Sequence[Match], names: Sequence[str]) -> list[Record]:
    """Printed logarithms and angles, those as scheduled and the nearest; angles of A, m, C as printed under A, C, m."""
    rows = []
    for i, name in enumerate(names):
        p, scheduled, best = PRINTED[name], match_of(matches, NATURAL, Processing()), matches[0]
        rows.append(_eigen_row(name, "paper", p.log10_eigenvalues, p.angles))
        for label, match in (("as scheduled", scheduled), ("nearest", best)):
            rows.append(_eigen_row(name, label, match.log10_eigenvalues[i], match.angles[i, [0, 2, 1]]))
    return rows


def _eigen_row(cycle: str, source: str, logarithms: Floats, angles: Floats) -> Record:
    values = np.concatenate([logarithms, angles]).tolist()
    columns = ("log λ1", "log λ2", "log λ3", "angle 1 [°]", "angle 2 [°]", "angle 3 [°]")
    return {"cycle": cycle, "source": source, **dict(zip(columns, values, strict=True))}


def column_order(best: Match, names: Sequence[str]) -> list[Record]:
    """Which parameters the printed angles and eigenvalues belong to, and the direction of the scatter between runs."""
    rows = []
    for name, order in zip(names, best.nearest, strict=True):
        p = PRINTED[name]
        A, C, m = p.estimates.T
        rows.append(
            {
                "cycle": name,
                "printed under A and C [°]": float(p.angles[0]),
                "scatter from A towards m [°]": list(angle(A, m)),
                "printed under m [°]": float(p.angles[2]),
                "scatter from A towards C [°]": list(angle(A, C)),
                "eigenvectors near": " / ".join(NAMES[i] for i in order),
            }
        )
    return rows


def vehicle(posteriors: Mapping[float, HierarchicalFit], names: Sequence[str]) -> list[Record]:
    """The hierarchical fit: mean and sd of the vehicle's μ and of the θ of each cycle, by the prior of β."""
    chosen = posteriors[BETWEEN_PRIORS[0]]
    rows = [
        {"parameters of": f"vehicle, β of {100 * scale:g} %", **parameters(p.mu.mean(0), p.mu.std(0))}
        for scale, p in posteriors.items()
    ]
    by_cycle = [(name, chosen.theta[:, i]) for i, name in enumerate(names)]
    return rows + [{"parameters of": name, **parameters(draws.mean(0), draws.std(0))} for name, draws in by_cycle]


def between_runs(chosen: HierarchicalFit, given: Mapping[str, Cycle]) -> list[Record]:
    """Spread between the runs of a cycle: κ, and the change of the estimates for 1 hp too much power."""
    return [
        {"cycle": name, "κ": interval(chosen.kappa[:, i]), **parameters(offset_response(cycle))}
        for i, (name, cycle) in enumerate(given.items())
    ]


def hyperparameters(chosen: HierarchicalFit) -> list[Record]:
    """τ, β, and the total resistance at cruising speed."""
    spread = {f"β of {name}": interval(chosen.beta[:, i]) for i, name in enumerate(PARAMETERS)}
    cruise = interval(chosen.mu @ [1.0, CRUISE**2, 0.0])
    rows = {"τ [hp]": interval(chosen.tau), **spread, "A + C v² at 55 mph [lbf]": cruise}
    return [{"hyperparameter": name, "90 % interval": found} for name, found in rows.items()] + [
        {"hyperparameter": "largest R-hat", "90 % interval": chosen.r_hat}
    ]


def coverage(studies: Mapping[str, CoverageStudy]) -> list[Record]:
    """Figure 4: median errors of thirds by coverage, and the variance of the error that log coverage explains."""
    rows = []
    for name, study in studies.items():
        explained = [np.corrcoef(np.log(study.coverage), np.abs(column))[0, 1] ** 2 for column in study.errors.T]
        for part in np.array_split(np.argsort(study.coverage), 3):
            median = np.median(np.abs(study.errors[part]), axis=0)
            row = {"cycle": name, "coverage": float(np.median(study.coverage[part])), **errors(median)}
            rows.append(row | {f"R² of {key}": float(x) for key, x in zip(NAMES, explained, strict=True)})
    return rows


def noise(studies: Mapping[str, NoiseStudy]) -> list[Record]:
    """Figure 5: powers of the noise with which residual, chi² and errors grow, and the bias at SHOWN_BIAS."""
    few, level = NOISE_LEVELS <= LINEAR_UP_TO, int(np.argmin(np.abs(NOISE_LEVELS - SHOWN_BIAS)))
    rows = []
    for rule, study in studies.items():
        grown = np.column_stack([study.residual, study.chi2, study.rms_errors])[few]
        exponents = np.polyfit(np.log(NOISE_LEVELS[few]), np.log(grown), 1)[0].tolist()
        at, count = study.errors[level], len(study.errors[level])
        bias = np.column_stack([at.mean(axis=0), at.std(axis=0, ddof=1) / np.sqrt(count)]).tolist()
        columns = ("power of residual", "power of chi²", *(f"power of {name}" for name in NAMES))
        biases = {f"bias of {name}": pair for name, pair in zip(NAMES, bias, strict=True)}
        rows.append({"samples kept": rule, **dict(zip(columns, exponents, strict=True)), **biases})
    return rows


def duration(studies: Mapping[str, DurationStudy]) -> list[Record]:
    """Figure 6: rms errors from the first part of each cycle, all of it, and copies with fresh noise."""
    rows = []
    for name, study in studies.items():
        for index in (0, *range(study.whole, len(study.seconds))):
            copies = (1, *COPIES)[index - study.whole] if index else 0
            row = {"cycle": name, "copies": copies or "first part", "duration [s]": float(study.seconds[index])}
            rows.append(row | errors(study.errors[index]))
    return rows


def selection(given: Mapping[str, Mapping[str, Floats]]) -> list[Record]:
    """Mean errors of least-squares fits, by the rule that keeps samples."""
    return [
        {"cycle": name, "rule": rule, **errors(off)} for name, rules in given.items() for rule, off in rules.items()
    ]


def _words(p: Processing) -> str:
    """Choices of the processing in words."""
    wobble = f", {100 * p.wobble:.0f} cm/s of speed noise" if p.wobble else ""
    chosen = "all samples" if p.selection == "all" else f"{p.selection} at the {p.parameters}"
    return f"{p.trace}{wobble}; {p.derivative} difference; {chosen}"
