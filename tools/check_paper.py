"""The paper's tables and figures made again with the program's own model, likelihood and random walk.

    python tools/check_paper.py [--pictures docs/paper]

Miller, Konan, Duran, "Bayesian Parameter Estimation for Heavy-Duty Vehicles", SAE 2017-01-0528. Its recordings are not
public; its printed numbers are in `paper/printed.py`. "Here" is computed from the printed numbers where they are
enough; otherwise power is simulated on the paper's cycles with white noise of the printed rms. HWFET and COMMUT come
with the project; HHDDTNC is read from the folder of recordings (ROADLOAD_DATA). Seeds are fixed.
"""

import argparse
import sys
from pathlib import Path

from harness.check import Cells, Check, Figures, Table
from paper import experiments, pictures, studies, summary
from paper.cycles import Cycle, all_parts, cycles_of
from paper.estimation import BURN_IN, Availability, Drive, scheduled_walk
from paper.printed import PRINTED
from paper.table_five import search
from paper.vehicle_posterior import BETWEEN_PRIORS, vehicle_posteriors
from paper.vehicles import DUMMY

from estimator.sampling.metropolis import REFRESH


def measure(options: argparse.Namespace) -> Figures:
    """Run every experiment, and draw the pictures."""
    parts = all_parts()
    cycles = cycles_of(parts)
    hwfet, names = cycles["HWFET"], list(cycles)
    reach = Availability.of(Cycle.joined(list(cycles.values())), DUMMY)
    matches, posteriors = search(parts), vehicle_posteriors(cycles)
    chosen = posteriors[BETWEEN_PRIORS[0]]
    runs = {name: experiments.runs(c) for name, c in cycles.items()}
    simulated = {name: experiments.means(repeated) for name, repeated in runs.items()}
    coverage = {n: studies.coverage_and_error(c, reach, i) for i, (n, c) in enumerate(cycles.items())}
    noise = studies.noise_and_error(hwfet)
    duration = {name: studies.duration_and_error(c) for name, c in cycles.items()}
    run = experiments.simulated_run(hwfet, 0)
    if options.pictures:
        folder = options.pictures
        folder.mkdir(parents=True, exist_ok=True)
        first = {name: repeated[0] for name, repeated in runs.items()}
        drive = Drive.of(hwfet, DUMMY, experiments.NOISE, (3, 0)).positive()
        walks = {
            "sigma and R frozen until iteration 5000": scheduled_walk(drive, BURN_IN),
            "refreshed from the start": scheduled_walk(drive, REFRESH),
        }
        pictures.random_walk(walks, folder / "fig1_random_walk.png")
        pictures.power_trace(run, first["HWFET"].mean, folder / "fig2_power_trace.png")
        pictures.coverage_map(cycles, reach, folder / "fig3_coverage_map.png")
        pictures.coverage_error(coverage, folder / "fig4_coverage_error.png")
        pictures.noise_error(noise, folder / "fig5_noise_error.png")
        pictures.duration_error(duration, folder / "fig6_duration_error.png")
        pictures.hierarchical_fit(chosen, names, folder / "hierarchical_fit.png")
        pictures.joint_posteriors(first, experiments.truth_of("HWFET"), folder / "appendix_joint_posteriors.png")
    printed = experiments.levene_tests({name: p.estimates for name, p in PRINTED.items()})
    return {
        "Cycles": summary.cycles(cycles, reach),
        "Dummy case without noise": summary.dummy({name: experiments.dummy_case(c) for name, c in cycles.items()}),
        "Table 1": summary.table_one(runs),
        "Tables 2 to 4": [
            summary.run_row(name, i, found) for name, repeated in runs.items() for i, found in enumerate(repeated)
        ],
        "Simulated runs": summary.chains(runs),
        "Scatter between runs": summary.scatter({n: experiments.scatter(n, x) for n, x in runs.items()}),
        "Levene's test between cycles": summary.levene(printed, experiments.levene_tests(simulated)),
        "Table 5": summary.table_five(matches, names),
        "Table 5, units": summary.units(matches),
        "Table 5, one choice at a time": summary.choices(matches),
        "Table 5, order of its columns": summary.column_order(matches[0], names),
        "Hierarchical fit": summary.vehicle(posteriors, names),
        "Hierarchical fit, runs": summary.between_runs(chosen, cycles),
        "Hierarchical fit, spreads": summary.hyperparameters(chosen),
        "Figure 1": experiments.schedule_effects(hwfet),
        "Figure 2": [experiments.residuals(run.positive(), runs["HWFET"][0].mean)],
        "Figure 4": summary.coverage(coverage),
        "Figure 5": summary.noise(noise),
        "Figure 6": summary.duration(duration),
        "Selection of samples": summary.selection({n: experiments.selection_bias(c) for n, c in cycles.items()}),
    }


def tables(figures: Figures) -> list[Table]:
    """A table for each of the paper's, and for each figure."""
    return [Table.of(title, records) for title, records in figures.items()]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the folder of the pictures."""
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw the figures too")


CHECK = Check(
    title="The paper's tables and figures",
    measure=measure,
    tables=tables,
    headline=Cells(columns=("90 % intervals that hold", "of"), table="Simulated runs"),
    options=add_options,
)

if __name__ == "__main__":
    sys.exit(CHECK.main())
