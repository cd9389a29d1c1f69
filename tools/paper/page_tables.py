"""The page's tables."""

import numpy as np

from estimator.sampling.identifiability import EigenMetrics
from paper.experiments import PAPER_RULE, PROGRAM_RULE, RUNS, SELECTION_FITS
from paper.results import PARAMETERS, Results, listed, nearest, percent, table, values
from paper.vehicles import DUMMY, DYNO, NAMES

SHOWN_RUNS = 3


def dummy(r: Results) -> str:
    """Table 1."""
    rows = [["set", *values(DUMMY), "", ""]]
    for d in r.dummy:
        off = [float(np.abs(mean / DUMMY - 1).max()) for mean, _ in (d.refreshed, d.frozen)]
        wide = float((d.frozen[1] / DUMMY).max())
        rows.append([d.cycle, *values(d.refreshed[0]), f"{off[0]:.1e}", f"{off[1]:.1e} ({100 * wide:.1f} % sd)"])
    header = ["", *PARAMETERS, "largest error", "largest error, sigma frozen to iteration 5000"]
    return f"""## Table 1: the dummy case

A = 300, C = 0.15, m = 2000, power from the model without noise, chains started at random inside the box. The
paper's estimates of this case are not at hand.

{table(header, rows)}

Without noise sigma shrinks at every refresh, down to a floor of 1 W set here, so refreshing from the start recovers
every parameter on every cycle. With the paper's schedule the first kept iterations still come from a wide sigma;
the means are right, but what is kept is far wider than it should be."""


def estimates(r: Results) -> str:
    """Tables 2-4 and Levene's test."""
    truth = ["set", *values(DYNO)]
    two = [truth + [""] * 2]
    three = []
    four = []
    for name, repeated in r.runs.items():
        draws = np.concatenate([run.draws for run in repeated])
        worst = max(run.r_hat for run in repeated)
        error = ", ".join(percent(draws.mean(axis=0) / DYNO - 1))
        two.append([name, *values(draws.mean(axis=0), np.mean([run.sd for run in repeated], axis=0)), error])
        two[-1].append(f"{worst:.3f}")
        for i, run in enumerate(repeated[:SHOWN_RUNS], 1):
            three.append([f"{name} {i}", *values(run.mean, run.sd), ", ".join(percent(run.mean / DYNO - 1))])
        scatter = np.std([run.mean for run in repeated], axis=0, ddof=1) / DYNO
        believed = np.mean([run.sd for run in repeated], axis=0) / DYNO
        held = np.sum([run.holds(DYNO) for run in repeated], axis=0)
        four += [
            [name, "sd between runs", *percent(scatter, 2, "")],
            [name, "sd of the posterior", *percent(believed, 2, "")],
            [name, f"90 % intervals that hold the truth, of {RUNS}", *map(str, held)],
        ]
    tests = [
        [f"estimates of {name}", f"{test.statistic:.2f}", f"{test.p:.3f}"]
        for name, test in zip(NAMES, r.levene_estimates, strict=True)
    ]
    tests.append(["power residuals", f"{r.levene_residuals.statistic:.2f}", f"{r.levene_residuals.p:.3f}"])
    different = [f"of {n}" for n, test in zip(NAMES, r.levene_estimates, strict=True) if test.p < 0.05]
    verdict = f"At 5 % the scatter {listed(different)} differs" if different else "At 5 % no scatter differs"
    residual = "differs too, which is chance" if r.levene_residuals.p < 0.05 else "does not, as it should"
    hhddt = ""
    if "HHDDT" in r.selection:
        paper, program = (f"{100 * r.selection['HHDDT'][rule][0]:+.1f} %" for rule in (PAPER_RULE, PROGRAM_RULE))
        hhddt = f""" On HHDDT the intervals hold the truth too seldom: keeping only P > 0 selects on the noise. Where
model power is near zero, as in much of that cycle, samples with positive noise stay and those with negative noise go.
Over {SELECTION_FITS} least-squares fits the mean error of A is {paper}; with the program's default rule, model power
above three sd of the residual, it is {program}."""
    return f"""## Tables 2-4: the dynamometer truck

{RUNS} runs of each cycle with fresh noise. Errors are those of A, C and m in that order. The paper's estimates and sd
are not at hand, and could not agree in digits: they are of measured power.

**Table 2, by cycle**: mean over all runs, and the mean posterior sd.

{table(["", *PARAMETERS, "error", "worst R-hat"], two)}

**Table 3, by run**: the first {SHOWN_RUNS} of each cycle.

{table(["run", *PARAMETERS, "error"], three)}

**Table 4, is the sd honest**: relative to the value set.

{table(["cycle", "", *NAMES], four)}

COMMUT has one launch and one cruise. It determines the mass and one combination of A and C; along the other the box
decides, so the posterior of A and C is wide and hardly moves from run to run (see the Appendix). On HWFET the two sd
agree as far as {RUNS} runs can tell, from which an sd is uncertain by {100 / np.sqrt(2 * RUNS - 2):.0f} %.{hhddt}

**Levene's test between cycles**, deviations from the median:

{table(["same variance on all cycles", "W", "p"], tests)}

{verdict} between cycles; that of the power residual {residual}, since the noise is the same everywhere. The paper's
statistics are not at hand."""


def _raw_row(label: str, metrics: EigenMetrics) -> list[str]:
    a, c, m = nearest(metrics)
    order = " / ".join(NAMES[int(i)] for i in metrics.angles.argmin(axis=1))
    return [label, " / ".join(f"{x:.2f}" for x in metrics.log10_eigenvalues), order, f"{a:.1f}", f"{m:.1f}", f"{c:.3f}"]


def table_five(r: Results) -> str:
    """Table 5, raw and scaled."""
    rows = [["paper, HWFET", "13.1 / 5.3 / 4.7", "not at hand", "0.020", "22", "22"]]
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

{table(["", *vectors], rows)}

The eigenvalues agree: {", ".join(f"{x:.2f}" for x in raw.log10_eigenvalues)} against 13.1, 5.3, 4.7. Two things
differ.

*Labels.* The largest eigenvalue is that of Σv⁶ and its eigenvector is the axis of C to within
{nearest(raw)[1]:.3f}°, an angle the paper gives to A. A and m rotate into each other, by the same angle because the
plane is then theirs alone. So the parameter that does not rotate is C, where the paper says A.

*The angle of A and m.* It is {nearest(raw)[0]:.1f}° with m as slug and {nearest(common)[0]:.1f}° with m in
lbf/(mph/s), against 22° printed. The mass enters only by deciding which samples have power above zero, and a lighter
truck has more of them; the paper chose by measured power on the driven trace, which may differ in the same way. It also
moves the second eigenvalue, {raw.log10_eigenvalues[1]:.2f} or {common.log10_eigenvalues[1]:.2f}. Table 5 leans towards
the lighter reading and the round weight towards slug, so neither settles the unit of mass.

**Scaled by the posterior**: JᵀJ / sigma² with each parameter in units of its posterior sd. Raw eigen-metrics depend on
units (v³ in mph is large, so C looks best known); these do not. An eigenvalue of 1 (log10 0) is what uncorrelated
parameters have; shares say of which parameters the direction is made.

{table(["cycle", "log10 eigenvalue", *NAMES], scaled)}

The best known direction is the sum of A and C, the load at cruising speed; what is least known is their difference,
mixed with m. On COMMUT it lies below 0 by more than an order of magnitude: the samples know less than the box."""
