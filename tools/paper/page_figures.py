"""The page's figures, and what they show."""

import numpy as np

from estimator.signals import Floats
from paper.experiments import NOISE, NOISE_LEVELS
from paper.results import Results, listed, percent, table
from paper.vehicles import NAMES


def _mean_and_error(runs: Floats) -> tuple[Floats, Floats]:
    """Mean over the first axis, and its standard error."""
    return runs.mean(axis=0), runs.std(axis=0, ddof=1) / np.sqrt(len(runs))


def figures(r: Results) -> str:
    """Figures 1-6 and the appendix, each with what it shows."""
    effects = [[f"{e.noise / 1e3:.0f}", e.schedule, f"{e.median:.2f}", f"{e.largest:.2f}"] for e in r.schedules]
    level = int(np.argmin(np.abs(NOISE_LEVELS - 20e3)))
    biases = [
        [rule, *(f"{x:+.1f} ± {s:.1f} %" for x, s in zip(*_mean_and_error(100 * e[level]), strict=True))]
        for rule, e in r.noise.items()
    ]
    covered = listed(f"{c.name} {100 * r.reach.coverage(c):.0f} %" for c in r.cycles)
    falls = r.coverage[1][np.argsort(r.coverage[0])]
    low, *_, high = (np.median(np.abs(part), axis=0) for part in np.array_split(falls, 5))
    seconds, errors = r.duration["HWFET"]
    return f"""## Figure 1: random walk of the mass

![Random walk of the mass](paper/fig1_random_walk.png)

HWFET, three chains from random starts in the box. Left, the paper's schedule: sigma and the steps' covariance R are
those of the random start until iteration 5000. Right, refreshed every 100 iterations from the start. Below, around the
end of the burn-in: when sigma shrinks at last, a chain that happens to be far out walks back through kept iterations.
The kept sd of the mass, over that with sigma fixed at the least-squares point:

{table(["noise [kW]", "first refresh", "median ratio", "largest"], effects)}

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
the least to the best covered fifth the median error falls from {", ".join(percent(low, 1, ""))} to
{", ".join(percent(high, 1, ""))} (A, C, m). A stretch that says nothing about C is off by little, because the dummy
truck's C is the middle of the box.

## Figure 5: noise and error

![Noise and error](paper/fig5_noise_error.png)

HWFET, dummy truck. Keeping P > 0, as the paper does, selects on the noise and biases all three parameters as it grows;
keeping samples whose model power is above three sd of the residual, the program's default, lessens the selection but
leaves fewer samples. Mean errors and their standard errors at 20 kW:

{table(["samples kept", *NAMES], biases)}

## Figure 6: duration and error

![Duration and error](paper/fig6_duration_error.png)

The first seconds of each cycle. On HWFET the median error of the mass falls from
{100 * errors[0, 2]:.1f} % after {seconds[0]:.0f} s to {100 * errors[-1, 2]:.2f} % after {seconds[-1]:.0f} s. COMMUT
gains little: its cruise repeats one sample. As in Figure 4, a small error of C early on is the middle of the box.

## Appendix: joint posteriors

![Joint posteriors](paper/appendix_joint_posteriors.png)

First run of each cycle; dashed is the truth. A and C lie on a ridge, and on COMMUT the box cuts it off at both ends."""
