"""Make the paper's tables and figures again with the program's own code: docs/paper.md and docs/paper/.

python tools/reproduce_paper.py [--output docs]

HWFET and COMMUT come with the project; HHDDT is read from the folder of recordings (ROADLOAD_DATA) and left out,
visibly, where that is absent.
"""

import argparse
import sys
from pathlib import Path

from paper import experiments, figures
from paper.cycles import Cycle
from paper.estimation import BURN_IN, Availability, Drive, scheduled_walk
from paper.page import render
from paper.results import Results
from paper.vehicles import DUMMY, DYNO
from rich.console import Console

from estimator.sampling.metropolis import REFRESH


def compute(console: Console) -> Results:
    """Run every experiment."""
    cycles = experiments.cycles_at_hand()
    hwfet, joined = cycles[0], Cycle.joined(cycles)
    if len(cycles) < 3:
        console.print("HHDDT is skipped: no recordings found; set ROADLOAD_DATA")

    with console.status("estimates by cycle and run"):
        runs = {c.name: experiments.runs(c) for c in cycles}
        dummy = [experiments.dummy_case(c) for c in cycles]
    with console.status("schedules"):
        schedules = experiments.schedule_effects(hwfet)
    with console.status("error by coverage, noise and duration"):
        coverage = experiments.coverage_and_error(joined)
        noise = experiments.noise_and_error(hwfet)
        duration = {c.name: experiments.duration_and_error(c) for c in cycles}
    return Results(
        cycles=cycles,
        dummy=dummy,
        runs=runs,
        selection={c.name: experiments.selection_bias(c) for c in cycles},
        levene_estimates=experiments.levene_of_estimates(runs),
        levene_residuals=experiments.levene_of_residuals(cycles, runs),
        eigen=experiments.table_five(cycles, runs),
        schedules=schedules,
        reach=Availability.of(joined, DUMMY),
        coverage=coverage,
        noise=noise,
        duration=duration,
    )


def draw(results: Results, folder: Path) -> None:
    """Write every figure."""
    drive = Drive.of(results.cycles[0], DYNO, experiments.NOISE, (1, 0))
    walks = {
        "sigma and R frozen until iteration 5000": scheduled_walk(drive.positive(), BURN_IN),
        "refreshed from the start": scheduled_walk(drive.positive(), REFRESH),
    }
    first_runs = {name: repeated[0] for name, repeated in results.runs.items()}
    figures.random_walk(walks, folder / "fig1_random_walk.png")
    figures.power_trace(drive, first_runs["HWFET"].mean, folder / "fig2_power_trace.png")
    figures.coverage_map(results.cycles, results.reach, folder / "fig3_coverage_map.png")
    figures.coverage_error(*results.coverage, folder / "fig4_coverage_error.png")
    figures.noise_error(results.noise, folder / "fig5_noise_error.png")
    figures.duration_error(results.duration, folder / "fig6_duration_error.png")
    figures.joint_posteriors(first_runs, folder / "appendix_joint_posteriors.png")


def main() -> int:
    """Compute, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("docs"), help="folder of paper.md and paper/")
    options = parser.parse_args()
    console = Console(stderr=True)
    results = compute(console)
    (options.output / "paper").mkdir(parents=True, exist_ok=True)
    draw(results, options.output / "paper")
    page = options.output / "paper.md"
    page.write_text(render(results), encoding="utf-8")
    console.print(f"{page} and {options.output / 'paper'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
