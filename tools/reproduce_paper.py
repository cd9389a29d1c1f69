"""Make the paper's tables and figures again with the program's own code: docs/paper.md and docs/paper/.

python tools/reproduce_paper.py [--output docs]

HWFET and COMMUT come with the project; HHDDTNC is read from the folder of recordings (ROADLOAD_DATA).
"""

import argparse
import sys
from pathlib import Path

from paper import experiments, figures, studies
from paper.cycles import Cycle, all_parts, cycles_of
from paper.estimation import BURN_IN, Availability, Drive, scheduled_walk
from paper.page import render
from paper.printed import PRINTED
from paper.results import Results
from paper.table_five import search
from paper.vehicle_posterior import BETWEEN_PRIORS, vehicle_posteriors
from paper.vehicles import DUMMY
from rich.console import Console

from estimator.sampling.metropolis import REFRESH
from estimator.signals import Floats


def compute(parts: dict[str, tuple[Floats, ...]], console: Console) -> Results:
    """Run every experiment."""
    cycles = cycles_of(parts)
    hwfet = cycles["HWFET"]
    reach = Availability.of(Cycle.joined(list(cycles.values())), DUMMY)
    with console.status("Table 5 and the hierarchical fit"):
        matches = search(parts)
        vehicle = vehicle_posteriors(cycles)
    with console.status("estimates by cycle and run"):
        runs = {name: experiments.runs(c) for name, c in cycles.items()}
        dummy = [experiments.dummy_case(c) for c in cycles.values()]
    with console.status("schedules"):
        schedules = experiments.schedule_effects(hwfet)
    with console.status("error by coverage, noise and duration"):
        coverage = {n: studies.coverage_and_error(c, reach, i) for i, (n, c) in enumerate(cycles.items())}
        noise = studies.noise_and_error(hwfet)
        duration = {name: studies.duration_and_error(c) for name, c in cycles.items()}
    kept = experiments.simulated_run(hwfet, 0).positive()
    return Results(
        cycles=cycles,
        dummy=dummy,
        runs=runs,
        trace=experiments.TraceFit.of(kept, runs["HWFET"][0].mean),
        scatter={name: experiments.scatter(name, repeated) for name, repeated in runs.items()},
        selection={name: experiments.selection_bias(c) for name, c in cycles.items()},
        levene_printed=experiments.levene_tests({name: p.estimates for name, p in PRINTED.items()}),
        levene_here=experiments.levene_tests({name: experiments.means(repeated) for name, repeated in runs.items()}),
        matches=matches,
        scaled=experiments.scaled_eigen_metrics(cycles, runs),
        vehicle=vehicle,
        schedules=schedules,
        reach=reach,
        coverage=coverage,
        noise=noise,
        duration=duration,
        copies=studies.exact_copies(cycles["HHDDTNC"]),
    )


def draw(results: Results, folder: Path) -> None:
    """Write every figure."""
    dummy = Drive.of(results.cycles["HWFET"], DUMMY, experiments.NOISE, (3, 0)).positive()
    walks = {
        "sigma and R frozen until iteration 5000": scheduled_walk(dummy, BURN_IN),
        "refreshed from the start": scheduled_walk(dummy, REFRESH),
    }
    first = {name: repeated[0] for name, repeated in results.runs.items()}
    drive = experiments.simulated_run(results.cycles["HWFET"], 0)
    names = list(results.cycles)
    figures.random_walk(walks, folder / "fig1_random_walk.png")
    figures.power_trace(drive, first["HWFET"].mean, folder / "fig2_power_trace.png")
    figures.coverage_map(results.cycles, results.reach, folder / "fig3_coverage_map.png")
    figures.coverage_error(results.coverage, folder / "fig4_coverage_error.png")
    figures.noise_error(results.noise, folder / "fig5_noise_error.png")
    figures.duration_error(results.duration, folder / "fig6_duration_error.png")
    figures.hierarchical_fit(results.vehicle[BETWEEN_PRIORS[0]], names, folder / "hierarchical_fit.png")
    figures.joint_posteriors(first, experiments.truth_of("HWFET"), folder / "appendix_joint_posteriors.png")


def main() -> int:
    """Compute, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("docs"), help="folder of paper.md and paper/")
    options = parser.parse_args()
    console = Console(stderr=True)
    try:
        parts = all_parts()
    except FileNotFoundError as error:
        console.print(f"error: {error.filename}: no such file; set ROADLOAD_DATA to the folder of recordings")
        return 2
    results = compute(parts, console)
    (options.output / "paper").mkdir(parents=True, exist_ok=True)
    draw(results, options.output / "paper")
    page = options.output / "paper.md"
    page.write_text(render(results), encoding="utf-8")
    console.print(f"{page} and {options.output / 'paper'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
