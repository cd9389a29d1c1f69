"""The result page: every number in it is computed, and stands beside the paper's where that is known."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from estimator.road_load import power
from estimator.sampling.identifiability import EigenMetrics
from estimator.signals import Floats
from estimator.units import STANDARD_GRAVITY
from paper.cycles import Cycle, tabulated_commut
from paper.estimation import Availability, Estimate
from paper.experiments import (
    NOISE,
    NOISE_LEVELS,
    RUNS,
    DummyCase,
    Levene,
    ScheduleEffect,
    TableFive,
)
from paper.vehicles import DUMMY, DYNO, LBF, MPH, NAMES, PAPER_UNITS, TO_SI

UNKNOWN = "not at hand"
DIGITS = (1, 4, 1)  # of A, C, m in the paper's units
SHOWN_RUNS = 3
PARAMETERS = [f"{name} [{unit}]" for name, unit in zip(NAMES, PAPER_UNITS, strict=True)]


@dataclass(frozen=True)
class Results:
    """Everything that is on the page; keys are names of cycles, arrays of parameters are [A, C, m]."""

    cycles: list[Cycle]
    dummy: list[DummyCase]
    runs: dict[str, list[Estimate]]
    levene_estimates: list[Levene]
    levene_residuals: Levene
    eigen: TableFive
    schedules: list[ScheduleEffect]
    reach: Availability
    coverage: tuple[Floats, Floats]
    noise: dict[str, Floats]
    duration: dict[str, tuple[Floats, Floats]]


def _table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    header = list(header)
    lines = [header, ["---"] * len(header), *map(list, rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _values(theta: Floats, sd: Floats | None = None) -> list[str]:
    """Parameters in the paper's units, with their sd where given."""
    theta = theta / TO_SI
    if sd is None:
        return [f"{x:.{d}f}" for x, d in zip(theta, DIGITS, strict=True)]
    return [f"{x:.{d}f} ± {s:.{d}f}" for x, s, d in zip(theta, sd / TO_SI, DIGITS, strict=True)]


def _percent(fractions: Iterable[float], digits: int = 1, sign: str = "+") -> list[str]:
    return [f"{100 * x:{sign}.{digits}f} %" for x in fractions]


def _listed(words: Iterable[str]) -> str:
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def _intro(r: Results) -> str:
    names = [c.name for c in r.cycles]
    tabulated = tabulated_commut()
    commut = next(c for c in r.cycles if c.name == "COMMUT")
    compared = ""
    if tabulated is not None:
        rms = np.sqrt(np.mean((commut.v - tabulated) ** 2)) / MPH
        compared = f" It differs from a published table of the cycle by {rms:.2f} mph rms."
    sources = {
        "HWFET": "table in 40 CFR part 600, appendix I (`tools/cycles/hwfet.csv`)",
        "COMMUT": f"generated from the description of SAE J1376: 330 s, 4.00 miles, 55 mph.{compared}",
        "HHDDT": "transient and cruise modes, without creep; tables outside the project",
    }
    rows = [
        [c.name, str(c.duration), f"{c.miles:.2f}", f"{power(c.v, c.a, DYNO).max() / 1e3:.0f}", sources[c.name]]
        for c in r.cycles
    ]
    if "HHDDT" not in names:
        rows.append(["HHDDT", "skipped", "", "", "its tables were not found; set `ROADLOAD_DATA`"])
    return f"""# The paper's results, reproduced

Miller, Konan, Duran, "Bayesian Parameter Estimation for Heavy-Duty Vehicles", SAE 2017-01-0528, NREL/CP-5400-67699.
`python tools/reproduce_paper.py` writes this page with the program's own model, likelihood and random walk. Seeds are
fixed: a second run gives the same numbers.

The paper measured a truck on a dynamometer. Those recordings are not public, so power here is the model's on the
paper's cycles, plus white Gaussian noise of {NOISE / 1e3:.0f} kW where nothing else is said. What this can show is
how the method behaves; what it cannot show is how well the model fits that truck. The cycles are followed exactly,
including accelerations for which a real tractor may lack the power (column "peak").

{_table(["cycle", "duration [s]", "distance [mi]", "peak [kW]", "source"], rows)}

Settings are the paper's: A in 0..500 lbf, C in 0.1..0.2 lbf/mph², m in 1000..5000; 10,000 iterations, of which 5,000
burn-in; 3 chains; only samples with measured power above zero. Acceleration is the central difference of the 1 Hz
speed. Unless Figure 1 says otherwise, sigma is fixed at the least-squares point and the chains start around it.

"Not at hand" marks printed numbers of the paper that were not available when this page was made. The paper's division
of its estimates over Tables 1-4 is not at hand either; the four tables below carry its content in an order of their
own."""


def _glance(r: Results) -> str:
    worst = max(float(np.abs(d.refreshed[0] / DUMMY - 1).max()) for d in r.dummy)
    raw, common = r.eigen.slug["HWFET"], r.eigen.common["HWFET"]
    five = " / ".join(f"{x:.1f}" for x in raw.log10_eigenvalues)
    rho = np.corrcoef(r.runs["HWFET"][0].draws[:, :2].T)[0, 1]
    falls = r.coverage[1][np.argsort(r.coverage[0])]
    thirds = [np.median(np.abs(part[:, 2])) for part in np.array_split(falls, 3)]
    hwfet = np.array([run.mean for run in r.runs["HWFET"]]).mean(axis=0) / DYNO - 1
    rows = [
        ["dummy case (Table 1)", "recovered", f"recovered to {worst:.0e} of each value"],
        [
            "dynamometer truck (Tables 2-4)",
            "391 lbf, 0.168 lbf/mph², 1863 slug set; estimates not at hand",
            f"HWFET, mean of {RUNS} runs: {', '.join(_percent(hwfet))} from A, C, m set",
        ],
        ["eigenvalues on HWFET, log10 (Table 5)", "13.1 / 5.3 / 4.7", five],
        [
            "angles on HWFET (Table 5)",
            "22°, 22°, 0.020°",
            f"{_nearest(raw)[0]:.0f}°, {_nearest(raw)[2]:.0f}°, {_nearest(raw)[1]:.3f}° (m as slug); "
            f"{_nearest(common)[0]:.0f}° for the first two with m in lbf/(mph/s)",
        ],
        ["parameter that does not rotate (Table 5)", "labelled A", "C"],
        [
            "error falls with coverage (Fig. 4)",
            UNKNOWN,
            f"mass, median of thirds by coverage: {', '.join(_percent(thirds, 2, ''))}",
        ],
        ["A against C (Appendix)", UNKNOWN, f"correlation {rho:.3f} on HWFET"],
    ]
    return f"## At a glance\n\n{_table(['result', 'paper', 'here'], rows)}"


def _units() -> str:
    crr = DYNO[0] / (DYNO[2] * STANDARD_GRAVITY)
    light = 1863 * LBF / MPH
    return f"""## The unit of mass

The paper labels mass "lbm". 1863 lbm is {1863 * 0.45359237:.0f} kg, which no class-8 tractor weighs. Read as slug it
is {DYNO[2]:,.0f} kg ({DYNO[2] / 0.45359237:,.0f} lbm), and A = 391 lbf is a rolling resistance coefficient of
{crr:.4f}, a normal truck tyre. This page reads slug. With speeds in mph there is one other consistent reading,
lbf/(mph/s): {light:,.0f} kg and a coefficient of {DYNO[0] / (light * STANDARD_GRAVITY):.4f}. Table 5 below is the
only place where the two differ."""


def _dummy(r: Results) -> str:
    rows = [["set", *_values(DUMMY), "", ""]]
    for d in r.dummy:
        off = [float(np.abs(mean / DUMMY - 1).max()) for mean, _ in (d.refreshed, d.frozen)]
        wide = float((d.frozen[1] / DUMMY).max())
        rows.append([d.cycle, *_values(d.refreshed[0]), f"{off[0]:.1e}", f"{off[1]:.1e} ({100 * wide:.1f} % sd)"])
    header = ["", *PARAMETERS, "largest error", "largest error, sigma frozen to iteration 5000"]
    return f"""## Table 1: the dummy case

A = 300, C = 0.15, m = 2000, power from the model without noise, chains started at random inside the box. Paper:
recovered; its digits are not at hand.

{_table(header, rows)}

Without noise sigma shrinks at every refresh, down to a floor of 1 W set here, so refreshing from the start recovers
every parameter on every cycle. With the paper's schedule the first kept iterations still carry the frozen sigma; the
means are right, but what is kept is far wider than it should be."""


def _estimates(r: Results) -> str:
    truth = ["set", *_values(DYNO)]
    two = [truth + [""] * 2]
    three = []
    four = []
    for name, repeated in r.runs.items():
        draws = np.concatenate([run.draws for run in repeated])
        worst = max(run.r_hat for run in repeated)
        error = ", ".join(_percent(draws.mean(axis=0) / DYNO - 1))
        two.append([name, *_values(draws.mean(axis=0), np.mean([run.sd for run in repeated], axis=0)), error])
        two[-1].append(f"{worst:.3f}")
        for i, run in enumerate(repeated[:SHOWN_RUNS], 1):
            three.append([f"{name} {i}", *_values(run.mean, run.sd), ", ".join(_percent(run.mean / DYNO - 1))])
        scatter = np.std([run.mean for run in repeated], axis=0, ddof=1) / DYNO
        believed = np.mean([run.sd for run in repeated], axis=0) / DYNO
        held = np.sum([run.holds(DYNO) for run in repeated], axis=0)
        four += [
            [name, "sd between runs", *_percent(scatter, 2, "")],
            [name, "sd of the posterior", *_percent(believed, 2, "")],
            [name, f"90 % intervals that hold the truth, of {RUNS}", *map(str, held)],
        ]
    tests = [
        [f"estimates of {name}", f"{test.statistic:.2f}", f"{test.p:.3f}"]
        for name, test in zip(NAMES, r.levene_estimates, strict=True)
    ]
    tests.append(["power residuals", f"{r.levene_residuals.statistic:.2f}", f"{r.levene_residuals.p:.3f}"])
    different = [f"of {n}" for n, test in zip(NAMES, r.levene_estimates, strict=True) if test.p < 0.05]
    verdict = f"At 5 % the scatter {_listed(different)} differs" if different else "At 5 % no scatter differs"
    residual = "differs too, which is chance" if r.levene_residuals.p < 0.05 else "does not, as it should"
    return f"""## Tables 2-4: the dynamometer truck

{RUNS} runs of each cycle with fresh noise. Errors are those of A, C and m in that order. The paper's estimates and sd
are not at hand, and could not agree in digits: they are of measured power.

**Table 2, by cycle**: mean over all runs, and the mean posterior sd.

{_table(["", *PARAMETERS, "error", "worst R-hat"], two)}

**Table 3, by run**: the first {SHOWN_RUNS} of each cycle.

{_table(["run", *PARAMETERS, "error"], three)}

**Table 4, is the sd honest**: relative to the value set.

{_table(["cycle", "", *NAMES], four)}

COMMUT has one launch and one cruise. It determines the mass and one combination of A and C; along the other the box
decides, so the posterior of A and C is wide and hardly moves from run to run (see the Appendix). Elsewhere the two sd
agree. The mean errors of A and C on HHDDT have one sign because keeping only P > 0 selects on the noise: where model
power is near zero, samples with positive noise stay and those with negative noise go (Figure 5).

**Levene's test between cycles**, deviations from the median:

{_table(["same variance on all cycles", "W", "p"], tests)}

{verdict} between cycles; that of the power residual {residual}, since the noise is the same everywhere. The paper's
statistics are not at hand."""


def _nearest(metrics: EigenMetrics) -> Floats:
    """Angle [deg] of every parameter's axis to the eigenvector nearest to it."""
    return metrics.angles.min(axis=0)


def _raw_row(label: str, metrics: EigenMetrics) -> list[str]:
    a, c, m = _nearest(metrics)
    order = " / ".join(NAMES[int(i)] for i in metrics.angles.argmin(axis=1))
    return [label, " / ".join(f"{x:.2f}" for x in metrics.log10_eigenvalues), order, f"{a:.1f}", f"{m:.1f}", f"{c:.3f}"]


def _table_five(r: Results) -> str:
    rows = [["paper, HWFET", "13.1 / 5.3 / 4.7", "A without rotation", "22", "22", "0.020"]]
    for c in r.cycles:
        rows.append(_raw_row(f"{c.name}, m as slug", r.eigen.slug[c.name]))
        rows.append(_raw_row(f"{c.name}, m as lbf/(mph/s)", r.eigen.common[c.name]))
    scaled = []
    for name, metrics in r.eigen.scaled.items():
        for value, angles in zip(metrics.log10_eigenvalues, metrics.angles, strict=True):
            shares = [f"{100 * x:.0f} %" for x in np.cos(np.radians(angles)) ** 2]
            scaled.append([name, f"{value:.2f}", *shares])
    raw, common = r.eigen.slug["HWFET"], r.eigen.common["HWFET"]
    vectors = ["log10 eigenvalues", "nearest parameter", "angle of A [°]", "of m [°]", "of C [°]"]
    return f"""## Table 5: eigen-metrics

**Raw**, of JᵀJ in mph and mph/s over the samples with model power above zero:

{_table(["", *vectors], rows)}

The eigenvalues agree: {", ".join(f"{x:.2f}" for x in raw.log10_eigenvalues)} against 13.1, 5.3, 4.7. Two things
differ.

*Labels.* The largest eigenvalue is that of Σv⁶ and its eigenvector is the axis of C to within
{_nearest(raw)[1]:.3f}°, the paper's third angle. A and m rotate into each other, by the same angle because the plane
is then theirs alone. So the parameter that does not rotate is C, where the paper says A.

*The angle of A and m.* It is {_nearest(raw)[0]:.1f}° with m as slug and {_nearest(common)[0]:.1f}° with m in
lbf/(mph/s), against 22° printed. The mass enters only by deciding which samples have power above zero, and a lighter
truck has more of them; the paper chose by measured power on the driven trace, which may differ in the same way. So
this does not settle the unit of mass.

**Scaled by the posterior**: JᵀJ / sigma² with each parameter in units of its posterior sd. Raw eigen-metrics depend on
units (v³ in mph is large, so C looks best known); these do not. An eigenvalue of 1 (log10 0) is what uncorrelated
parameters have; shares say of which parameters the direction is made.

{_table(["cycle", "log10 eigenvalue", *NAMES], scaled)}

The best known direction is the sum of A and C, the load at cruising speed; what is least known is their difference,
mixed with m. On COMMUT it lies below 0 by more than an order of magnitude: the samples know less than the box."""


def _figures(r: Results) -> str:
    effects = [[f"{e.noise / 1e3:.0f}", e.schedule, f"{e.median:.2f}", f"{e.largest:.2f}"] for e in r.schedules]
    level = int(np.argmin(np.abs(NOISE_LEVELS - 20e3)))
    biases = {rule: 100 * e[level].mean(axis=0) for rule, e in r.noise.items()}
    bias = "; ".join(f"{rule}: {', '.join(f'{x:+.1f} %' for x in b)}" for rule, b in biases.items())
    covered = _listed(f"{c.name} {100 * r.reach.coverage(c):.0f} %" for c in r.cycles)
    falls = r.coverage[1][np.argsort(r.coverage[0])]
    low, *_, high = (np.median(np.abs(part), axis=0) for part in np.array_split(falls, 5))
    seconds, errors = r.duration["HWFET"]
    return f"""## Figure 1: random walk of the mass

![Random walk of the mass](paper/fig1_random_walk.png)

HWFET, three chains from random starts in the box. Left, the paper's schedule: sigma and the steps' covariance R are
those of the random start until iteration 5000. Right, refreshed every 100 iterations from the start. Below, around the
end of the burn-in: when sigma shrinks at last, a chain that happens to be far out walks back through kept iterations.
The kept sd of the mass, over that with sigma fixed at the least-squares point:

{_table(["noise [kW]", "first refresh", "median ratio", "largest"], effects)}

The less noise there is, the more the frozen start widens. Whether the paper refreshed first at 5000 or at 5100 is not
at hand; refreshing from the start costs nothing and has neither effect.

## Figure 2: power trace

![Power trace](paper/fig2_power_trace.png)

HWFET, first run. The residual has an sd of {r.runs["HWFET"][0].sigma / 1e3:.2f} kW over the samples kept; the noise
put in had {NOISE / 1e3:.0f} kW.

## Figure 3: coverage

![Coverage map](paper/fig3_coverage_map.png)

Cells of 2.5 m/s by 0.1 m/s²; grey cells are available (model power above zero and within the highest power, speed
and acceleration of all cycles), coloured ones occupied: {covered}. The paper's cell sizes are not at hand.

## Figure 4: coverage and error

![Coverage and error](paper/fig4_coverage_error.png)

Random stretches of the joined cycles, dummy truck, {NOISE / 1e3:.0f} kW noise; the line joins medians of fifths. From
the least to the best covered fifth the median error falls from {", ".join(_percent(low, 1, ""))} to
{", ".join(_percent(high, 1, ""))} (A, C, m). A stretch that says nothing about C is off by little, because the dummy
truck's C is the middle of the box.

## Figure 5: noise and error

![Noise and error](paper/fig5_noise_error.png)

HWFET, dummy truck. Keeping P > 0, as the paper does, selects on the noise and biases all three parameters as it grows;
keeping samples whose model power is above three sd of the residual, the program's default, removes most of that but
leaves fewer samples. At 20 kW the mean errors of A, C, m are: {bias}.

## Figure 6: duration and error

![Duration and error](paper/fig6_duration_error.png)

The first seconds of each cycle. On HWFET the median error of the mass falls from
{100 * errors[0, 2]:.1f} % after {seconds[0]:.0f} s to {100 * errors[-1, 2]:.2f} % after {seconds[-1]:.0f} s. COMMUT
gains little: its cruise repeats one sample. As in Figure 4, a small error of C early on is the middle of the box.

## Appendix: joint posteriors

![Joint posteriors](paper/appendix_joint_posteriors.png)

First run of each cycle; dashed is the truth. A and C lie on a ridge, and on COMMUT the box cuts it off at both ends."""


def render(results: Results) -> str:
    """The whole page."""
    sections = [_intro(results), _glance(results), _units()]
    sections += [part(results) for part in (_dummy, _estimates, _table_five, _figures)]
    return "\n\n".join(sections) + "\n"
