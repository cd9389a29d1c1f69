"""The page's Figures 1 to 6 and the appendix, each with the paper's statement and the result here."""

from dataclasses import dataclass

import numpy as np

from estimator.signals import Floats
from paper.experiments import NOISE, PAPER_RULE, PROGRAM_RULE
from paper.results import Results, listed, percent, table
from paper.studies import COPIES, NOISE_LEVELS, NOISE_REPEATS, PARTS, CoverageStudy, NoiseStudy
from paper.vehicles import HP, NAMES

LINEAR_UP_TO = 10 * HP  # W, noise up to which the errors are fitted by a power of it
SHOWN_BIAS = 20 * HP  # W


@dataclass(frozen=True)
class Exponents:
    """Powers of the noise with which the ``residual`` rms, ``chi2`` and the rms ``errors`` (3,) of A, C, m grow."""

    residual: float
    chi2: float
    errors: Floats


def noise_exponents(study: NoiseStudy) -> Exponents:
    """Least-squares slopes over the logarithm of the noise."""
    few = NOISE_LEVELS <= LINEAR_UP_TO
    x = np.log(NOISE_LEVELS[few])
    residual, chi2 = (float(np.polyfit(x, np.log(y[few]), 1)[0]) for y in (study.residual, study.chi2))
    return Exponents(residual, chi2, np.polyfit(x, np.log(study.rms_errors[few]), 1)[0])


def coverage_percent(r: Results) -> str:
    """Coverage of every cycle, in words."""
    return listed(f"{name} {100 * r.reach.coverage(c):.0f} %" for name, c in r.cycles.items())


def figures(r: Results) -> str:
    """Figures 1-6 and the appendix."""
    return "\n\n".join([_one(r), _two(r), _three(r), _four(r), _five(r), _six(r), _appendix()])


def _one(r: Results) -> str:
    effects = [[f"{e.noise / HP:.0f}", e.schedule, f"{e.median:.2f}", f"{e.largest:.2f}"] for e in r.schedules]
    return f"""## Figure 1: random walk of the mass

![Random walk of the mass](paper/fig1_random_walk.png)

HWFET, dummy vehicle, three chains from random starts in the box. Left, the paper's schedule: sigma and the covariance R
of the steps are those of the random start until iteration 5000. Right, refreshed every 100 iterations from the start.
Below, the iterations around the end of the burn-in: when sigma shrinks, a chain that is far out walks back through kept
iterations. The kept sd of the mass, over that with sigma fixed at the least-squares point:

{table(["noise [hp]", "first refresh", "median ratio", "largest"], effects)}

The less noise there is, the more the frozen start widens. The paper refreshes every 100 iterations; both readings of
"after the burn-in" are shown. Refreshing from the start costs nothing and has neither effect."""


def _two(r: Results) -> str:
    return f"""## Figure 2: power trace

![Power trace](paper/fig2_power_trace.png)

HWFET, first simulated run. The paper finds the best fit nearer to the measured power than the nominal parameters. Here,
where the truck has the parameters of the printed runs, the rms of the residual over the samples kept is
{r.trace.best / HP:.2f} hp with the best fit and {r.trace.nominal / HP:.1f} hp with the nominal parameters; the printed
rms of the best fits is 4.8 to 7.4 hp."""


def _three(r: Results) -> str:
    return f"""## Figure 3: coverage

![Coverage map](paper/fig3_coverage_map.png)

Cells of 2.5 m/s by 0.1 m/s², a choice made here; grey cells are available (model power above zero and within the
highest power, speed and acceleration of all cycles), coloured ones occupied: {coverage_percent(r)}. The paper, too,
finds less on COMMUT than on HWFET."""


def r_squared(study: CoverageStudy) -> dict[str, Floats]:
    """Share (3,) of the variance of the absolute errors explained by a straight line, for three choices of axes."""
    error, coverage = np.abs(study.errors), study.coverage

    def explained(x: Floats, y: Floats) -> Floats:
        return np.array([np.corrcoef(x, column)[0, 1] ** 2 for column in y.T])

    return {
        "error on coverage": explained(coverage, error),
        "error on log coverage": explained(np.log(coverage), error),
        "log error on log coverage": explained(np.log(coverage), np.log(error)),
    }


def _four(r: Results) -> str:
    rows = []
    for name, study in r.coverage.items():
        thirds = np.array_split(np.argsort(study.coverage), 3)
        medians = [np.median(np.abs(study.errors[part]), axis=0) for part in thirds]
        covered = " / ".join(f"{100 * np.median(study.coverage[part]):.0f}" for part in thirds)
        rows.append([name, covered, *(" / ".join(f"{100 * m[i]:.1f}" for m in medians) for i in range(3))])
    fits = []
    for name in ("HWFET", "HHDDTNC"):
        explained = r_squared(r.coverage[name])
        fits += [[name, axes, *(f"{x:.2f}" for x in shares)] for axes, shares in explained.items()]
    return f"""## Figure 4: coverage and error

![Coverage and error](paper/fig4_coverage_error.png)

{PARTS} random stretches of each cycle, from 60 s to all of it, dummy vehicle, {NOISE / HP:.0f} hp noise. Medians of
thirds by coverage, from the least to the best covered, in %:

{table(["cycle", "coverage", *(f"error of {x}" for x in NAMES)], rows)}

The paper finds an error that falls about with the logarithm of the coverage and is worst on COMMUT. COMMUT is worst
here, too: its best covered third, which is nearly all of it, has errors as large as the least covered thirds of the
other cycles. Its stretches with the least coverage are steady cruising; they do not determine A and C, whose means
are then near the middle of the box, and so near the dummy vehicle's. On the other cycles a straight line explains
these shares of the variance of the error (R²):

{table(["cycle", "", *NAMES], fits)}

The error on the logarithm of the coverage has the largest share or nearly so, which supports the paper's form; single
estimates scatter too much to separate the forms further."""


def _five(r: Results) -> str:
    level = int(np.argmin(np.abs(NOISE_LEVELS - SHOWN_BIAS)))
    biases = []
    for rule, study in r.noise.items():
        errors = 100 * study.errors[level]
        mean, error = errors.mean(axis=0), errors.std(axis=0, ddof=1) / np.sqrt(len(errors))
        biases.append([rule, *(f"{x:+.1f} ± {s:.1f} %" for x, s in zip(mean, error, strict=True))])
    growth = []
    for rule, study in r.noise.items():
        e = noise_exponents(study)
        growth.append([rule, f"{e.residual:.2f}", f"{e.chi2:.2f}", *(f"{x:.2f}" for x in e.errors)])
    at_five = r.noise[PAPER_RULE].rms_errors[int(np.argmin(np.abs(NOISE_LEVELS - NOISE)))]
    return f"""## Figure 5: noise and error

![Noise and error](paper/fig5_noise_error.png)

HWFET, dummy vehicle, {NOISE_REPEATS} noises at each level. The paper says that the rms error grows with the square of
the noise magnitude and that A and C have the largest errors. Powers of the noise with which the rms residual, chi²
and the rms errors of A, C and m grow up to {LINEAR_UP_TO / HP:.0f} hp:

{table(["samples kept", "rms residual", "chi²", *(f"error of {x}" for x in NAMES)], growth)}

So a root mean square grows in proportion and chi² with the square: the paper's statement holds for chi², the quantity
in its likelihood. The order is confirmed: at {NOISE / HP:.0f} hp the rms errors of A, C and m are
{listed(percent(at_five, 1, ""))}. Above that, the rule P > 0 selects on the noise and adds a bias. Mean errors and
their standard errors at {SHOWN_BIAS / HP:.0f} hp:

{table(["samples kept", *NAMES], biases)}

"{PROGRAM_RULE}" is the program's default rule: samples whose model power is above three sd of the residual."""


def _six(r: Results) -> str:
    rows = []
    for name, study in r.duration.items():
        for index in (0, study.whole, *range(study.whole + 1, len(study.seconds))):
            copies = (1, *COPIES)[index - study.whole] if index >= study.whole else 0
            label = f"{copies} x" if copies else "first part"
            rows.append([name, label, f"{study.seconds[index]:.0f}", *percent(study.errors[index], 2, "")])
    mean, sd = r.copies
    bias = percent(r.selection["HHDDTNC"][PAPER_RULE])[0]
    change = 100 * np.abs(mean - 1).max()
    return f"""## Figure 6: duration and error

![Duration and error](paper/fig6_duration_error.png)

Rms error from the first seconds of each cycle, from all of it, and from copies of it with fresh noise of
{NOISE / HP:.0f} hp (the unit of the paper's noise of 5 is taken to be hp):

{table(["cycle", "", "duration [s]", *(f"error of {x}" for x in NAMES)], rows)}

The paper finds that copies of HHDDTNC at noise 5 change nearly nothing. Here the error of A falls, but eight copies do
not reduce it by √8: the rule P > 0 has a bias on this cycle ({bias} in A on the truck of Tables 2-4), which no amount
of data averages out. If the noise is copied too, eight copies change the estimate by {change:.2f} % and divide its sd
by {1 / sd.mean():.2f}, √8, although the copies contain no new information. On COMMUT copies change the errors little:
those of A and C are set by the box."""


def _appendix() -> str:
    return """## Appendix: joint posteriors

![Joint posteriors](paper/appendix_joint_posteriors.png)

First simulated run of each cycle; dashed are the parameters set for HWFET. A and C lie on a ridge, and on COMMUT the
box cuts it off at both ends."""
