"""The result page: the printed numbers beside computed ones; no number in it is written by hand."""

import numpy as np

from estimator.model.road_load import power
from estimator.units import STANDARD_GRAVITY
from paper.cycles import tabulated_commut
from paper.experiments import PAPER_RULE
from paper.page_figures import coverage_percent, figures, noise_exponents
from paper.page_runs import run_tables
from paper.page_table_five import NATURAL, match_of, table_five
from paper.page_vehicle import vehicle
from paper.printed import PRINTED
from paper.results import Results, listed, percent, printed_values, reflow, table
from paper.table_five import Processing
from paper.vehicle_posterior import BETWEEN_PRIORS
from paper.vehicles import HP, LBF, MPH, NOMINAL, TO_SI


def _intro(r: Results) -> str:
    rms = np.sqrt(np.mean((r.cycles["COMMUT"].v - tabulated_commut()) ** 2)) / MPH
    sources = {
        "HWFET": "table in 40 CFR part 600, appendix I (`tools/cycles/hwfet.csv`)",
        "COMMUT": "generated from the description of SAE J1376: 330 s, 4.00 miles, 55 mph. "
        f"It differs from a published table of the cycle by {rms:.2f} mph rms.",
        "HHDDTNC": "transient and cruise modes of the HHDDT schedule, no creep; tables outside the project",
    }
    rows = [
        [name, str(c.duration), f"{c.miles:.2f}", f"{power(c.v, c.a, NOMINAL).max() / 1e3:.0f}", sources[name]]
        for name, c in r.cycles.items()
    ]
    return f"""# The paper's results, reproduced

Miller, Konan, Duran, "Bayesian Parameter Estimation for Heavy-Duty Vehicles", SAE 2017-01-0528, NREL/CP-5400-67699.
`python tools/reproduce_paper.py` writes this page and its figures with the program's own model, likelihood and random
walk. Seeds are fixed: a second run gives the same numbers.

The paper measured a truck on a chassis dynamometer. Its recordings are not public; its printed numbers are in
`tools/paper/printed.py`, and all of them are on this page. "Here" means one of two things. Where the paper prints
enough, a result is computed from the printed numbers themselves (Levene's test, Table 5, the hierarchical fit).
Otherwise power is simulated: the model's power on the paper's cycles plus white Gaussian noise. A simulated run of
Tables 1-4 has the parameters that the paper found on its cycle and the residual rms that it printed for that run. So
the means are set, and the test is how far the estimates scatter around them.

{table(["cycle", "duration [s]", "distance [mi]", "peak [kW]", "source"], rows)}

The column "peak" is the power that the nominal truck would need to follow the cycle exactly.

Settings are the paper's: A in 0..500 lbf, C in 0.1..0.2 lbf/mph², m in 1000..5000; 10,000 iterations, of which 5,000
are burn-in; 3 chains from random starts; only samples with measured power above zero. Acceleration is the central
difference of the 1 Hz speed. Except under Figure 1, sigma is fixed at the least-squares point."""


def _glance(r: Results) -> str:
    rows = [*_glance_at_tables(r), *_glance_at_figures(r)]
    return f"## At a glance\n\n{table(['result', 'paper', 'here'], rows)}"


def _glance_at_tables(r: Results) -> list[list[str]]:
    off = [p.estimates.mean(axis=0) * TO_SI / NOMINAL - 1 for p in PRINTED.values()]
    sds = {name: p.estimates.std(axis=0, ddof=1) for name, p in PRINTED.items()}
    chains = np.mean([run.chain_deviation for repeated in r.runs.values() for run in repeated])
    largest = np.abs(r.matches[0].differences[:, :3]).max()
    off_by = np.abs(match_of(r.matches, NATURAL, Processing()).differences).max(axis=0)
    five_percent = sum(test.p < 0.05 for test in r.levene_printed)
    return [
        [
            "A and m found (Table 1)",
            "A about 30 % below nominal, m 1 % above",
            f"printed runs: A {listed(percent([x[0] for x in off], 0))}, m {listed(percent([x[2] for x in off]))}",
        ],
        [
            "sd between runs, COMMUT over HWFET (A, C, m)",
            "about 10",
            f"printed runs: {', '.join(f'{x:.1f}' for x in sds['COMMUT'] / sds['HWFET'])}; posterior sd of simulated "
            f"runs: {', '.join(f'{x:.1f}' for x in r.scatter['COMMUT'].posterior / r.scatter['HWFET'].posterior)}",
        ],
        [
            "Levene's test between cycles",
            "variance of COMMUT differs",
            f"printed runs: differs for {five_percent} of 3 parameters at 5 %",
        ],
        ["deviation between chains", "< 1 % on average", f"{100 * chains:.2f} % on average"],
        [
            "eigenvalues (Table 5)",
            "9 printed logarithms",
            f"P in lbf ft/s, m in slug: as scheduled, λ1 within {off_by[0]:.3f}, λ2 within {off_by[1]:.2f}, "
            f"λ3 of COMMUT {off_by[2]:.1f} off; all 9 within {largest:.2f} with an assumed trace",
        ],
        ["parameter that does not rotate (Table 5)", "m", "C; the printed columns are in the wrong order"],
    ]


def _glance_at_figures(r: Results) -> list[list[str]]:
    exponents = noise_exponents(r.noise[PAPER_RULE])
    duration = r.duration["HHDDTNC"]
    once, most = 100 * duration.errors[duration.whole, 0], 100 * duration.errors[-1, 0]
    posterior = r.vehicle[BETWEEN_PRIORS[0]].vehicle
    return [
        [
            "residual on HWFET (Fig. 2)",
            "best fit nearer to the measured power than nominal",
            f"{r.trace.best / HP:.1f} hp against {r.trace.nominal / HP:.1f} hp",
        ],
        ["coverage (Fig. 3)", "COMMUT below HWFET", coverage_percent(r)],
        [
            "error by coverage (Fig. 4)",
            "falls about logarithmically; worst on COMMUT",
            "falls; worst on COMMUT; a logarithm explains it as well as other forms or better",
        ],
        [
            "error by noise (Fig. 5)",
            "rms error grows with the square of the noise; A and C first",
            f"rms residual with the power {exponents.residual:.2f}, chi² with {exponents.chi2:.2f}, errors with "
            f"{listed(f'{x:.2f}' for x in exponents.errors)}; A and C first",
        ],
        [
            "copies of HHDDTNC at noise 5 (Fig. 6)",
            "change nearly nothing",
            f"rms error of A {once:.1f} % from one, {most:.1f} % from eight: the rest is a bias of the rule P > 0",
        ],
        [
            "hierarchical fit over runs (conclusion)",
            "proposed",
            ", ".join(printed_values(posterior.mean(axis=0), posterior.std(axis=0))) + " (A, C, m of the vehicle)",
        ],
    ]


def _units() -> str:
    rolling = NOMINAL[0] / (NOMINAL[2] * STANDARD_GRAVITY)
    light = 1863 * LBF / MPH
    return f"""## The unit of mass

The paper labels mass "lbm". 1863 lbm is {1863 * 0.45359237:.0f} kg, too little for any class-8 tractor. Read as slug it
is {NOMINAL[2]:,.0f} kg ({NOMINAL[2] / 0.45359237:,.0f} lbm, next to a round 60,000), and A = 391 lbf is a rolling
resistance coefficient of {rolling:.4f}, a normal truck tyre. With speeds in mph there is one other consistent reading,
lbf/(mph/s): {light:,.0f} kg and a coefficient of {NOMINAL[0] / (light * STANDARD_GRAVITY):.4f}. Table 5 decides for
slug, see there. All masses on this page are in slug."""


def render(results: Results) -> str:
    """The whole page."""
    sections = [
        _intro(results),
        _glance(results),
        _units(),
        run_tables(results),
        table_five(results),
        vehicle(results.vehicle, results.cycles),
        figures(results),
    ]
    return reflow("\n\n".join(sections))
