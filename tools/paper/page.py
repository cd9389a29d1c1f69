"""The result page: every number in it is computed, and stands beside the paper's where that is known."""

import numpy as np

from estimator.road_load import power
from estimator.units import STANDARD_GRAVITY
from paper.cycles import tabulated_commut
from paper.experiments import NOISE, RUNS
from paper.page_figures import figures
from paper.page_tables import dummy, estimates, table_five
from paper.results import UNKNOWN, Results, nearest, percent, reflow, table
from paper.vehicles import DUMMY, DYNO, LBF, MPH


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

{table(["cycle", "duration [s]", "distance [mi]", "peak [kW]", "source"], rows)}

Settings are the paper's: A in 0..500 lbf, C in 0.1..0.2 lbf/mph², m in 1000..5000; 10,000 iterations, of which 5,000
burn-in; 3 chains; only samples with measured power above zero. Acceleration is the central difference of the 1 Hz
speed. Unless Figure 1 says otherwise, sigma is fixed at the least-squares point and the chains start around it.

"Not at hand" marks printed numbers of the paper that were not available when this page was made. The paper's division
of its estimates over Tables 1-4 is not at hand either; the four tables below carry its content in an order of their
own."""


def _glance(r: Results) -> str:
    worst = max(float(np.abs(d.refreshed[0] / DUMMY - 1).max()) for d in r.dummy)
    raw, common = r.eigen.slug["HWFET"], r.eigen.common["HWFET"]
    five = " / ".join(f"{x:.2f}" for x in raw.log10_eigenvalues)
    rho = np.corrcoef(r.runs["HWFET"][0].draws[:, :2].T)[0, 1]
    falls = r.coverage[1][np.argsort(r.coverage[0])]
    thirds = [np.median(np.abs(part[:, 2])) for part in np.array_split(falls, 3)]
    hwfet = np.array([run.mean for run in r.runs["HWFET"]]).mean(axis=0) / DYNO - 1
    rows = [
        [
            "dummy case (Table 1)",
            "300 lbf, 0.15 lbf/mph², 2000 set; estimates not at hand",
            f"recovered to {worst:.0e} of each value",
        ],
        [
            "dynamometer truck (Tables 2-4)",
            "391 lbf, 0.168 lbf/mph², 1863 slug set; estimates not at hand",
            f"HWFET, mean of {RUNS} runs: {', '.join(percent(hwfet))} from A, C, m set",
        ],
        ["eigenvalues on HWFET, log10 (Table 5)", "13.1 / 5.3 / 4.7", five],
        [
            "angles on HWFET (Table 5)",
            "22°, 22°, 0.020°",
            f"{nearest(raw)[0]:.1f}°, {nearest(raw)[2]:.1f}°, {nearest(raw)[1]:.3f}° with m as slug; "
            f"{nearest(common)[0]:.1f}° for the first two with m in lbf/(mph/s)",
        ],
        ["parameter that does not rotate (Table 5)", "A", "C"],
        [
            "error falls with coverage (Fig. 4)",
            UNKNOWN,
            f"mass, median of thirds by coverage: {', '.join(percent(thirds, 2, ''))}",
        ],
        ["A against C (Appendix)", UNKNOWN, f"correlation {rho:.3f} on HWFET"],
    ]
    return f"## At a glance\n\n{table(['result', 'paper', 'here'], rows)}"


def _units() -> str:
    crr = DYNO[0] / (DYNO[2] * STANDARD_GRAVITY)
    light = 1863 * LBF / MPH
    return f"""## The unit of mass

The paper labels mass "lbm". 1863 lbm is {1863 * 0.45359237:.0f} kg, which no class-8 tractor weighs. Read as slug it
is {DYNO[2]:,.0f} kg ({DYNO[2] / 0.45359237:,.0f} lbm, next to a round 60,000), and A = 391 lbf is a rolling
resistance coefficient of
{crr:.4f}, a normal truck tyre. This page reads slug. With speeds in mph there is one other consistent reading,
lbf/(mph/s): {light:,.0f} kg and a coefficient of {DYNO[0] / (light * STANDARD_GRAVITY):.4f}. Of the
printed results at hand, only Table 5 tells the two apart."""


def render(results: Results) -> str:
    """The whole page."""
    sections = [_intro(results), _glance(results), _units()]
    sections += [part(results) for part in (dummy, estimates, table_five, figures)]
    return reflow("\n\n".join(sections))
