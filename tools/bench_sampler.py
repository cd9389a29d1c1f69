"""Effective draws per CPU second of roadload's samplers and of other libraries, all from the same posterior.

    python tools/bench_sampler.py [--samples 1000 10000 100000]

The others are installed by ``tools/peers/samplers.txt``; those that are missing are named and left out. Counted is the
CPU time of this process on one thread, burn-in included, and the smallest bulk ESS (ArviZ) over A, C and m. Steps that
run once are not counted for any: fit, compilation, and for NUTS (to its advantage) the warm-up. Means and standard
deviations are printed, so that it can be checked that all rows sample the same posterior.
"""

import argparse
import os
import sys
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from arviz_stats.base.array import array_stats
from harness.check import Cells, Check, Figures, Table
from peers.samplers import BOX, Problem, blackjax_nuts, emcee_stretch, paper, pymcmcstat_dram, samples

from estimator.sampling.clipped import ClippedGaussianTarget
from estimator.sampling.likelihood import in_box
from estimator.sampling.metropolis import KERNELS
from estimator.sampling.run import overdispersed
from estimator.signals import Floats

ONE_THREAD = {
    "OPENBLAS_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}


def ours(q: Problem, kernel: str, burn_in: int, draws: int, repetitions: int) -> Floats:
    """Draws (chains, draws, 3) by one of roadload's kernels, 256 chains."""
    starts = overdispersed(q.target, 256, q.rng)
    return q.timed(lambda: KERNELS[kernel](q.target, starts, burn_in, draws, q.rng).draws, repetitions)


def floor(q: Problem) -> Floats:
    """The Gaussian approximation, cut by the box: independent draws, not exact."""
    root, (lower, upper) = q.root, BOX

    def work() -> Floats:
        theta = q.rng.standard_normal((25_600, 3)) @ root.T + q.target.centre
        return theta[in_box(theta, lower, upper)]

    draws = q.timed(work, 31)
    return draws[: len(draws) // 256 * 256].reshape(256, -1, 3)


PARAMETERS = ("A [N]", "C [N s²/m²]", "m [kg]")
OURS, FLOOR = "roadload, independence", "floor: cut Gaussian, not exact"
ROWS: dict[str, Callable[[Problem], Floats]] = {
    OURS: lambda q: ours(q, "independence", 5, 100, 31),
    "roadload, random walk": lambda q: ours(q, "random_walk", 300, 700, 1),
    "paper's algorithm, plain numpy": paper,
    "emcee": emcee_stretch,
    "pymcmcstat DRAM": pymcmcstat_dram,
    "blackjax NUTS": blackjax_nuts,
    FLOOR: floor,
}


def compare(n: int) -> Figures:
    """Rates of ESS [1/s] and moments of the draws by sampler, from ``n`` samples; text where one is left out."""
    X, P = samples(n, np.random.default_rng(n))
    target, found = ClippedGaussianTarget(X, P, *BOX), dict[str, Any]()
    for name, work in ROWS.items():
        problem = Problem(X=X, P=P, target=target, rng=np.random.default_rng(1))
        try:
            draws = work(problem)
        except ModuleNotFoundError as error:
            found[name] = f"left out: {error}"
            continue
        sizes = [float(array_stats.ess(draws[:, :, i])) for i in range(3)]  # type: ignore[no-untyped-call]
        moments = [[float(x.mean()), float(x.std())] for x in draws.reshape(-1, 3).T]
        found[name] = {"ess_per_s": min(sizes) / problem.seconds, "moments": moments}
    return found


def measure(options: argparse.Namespace) -> Figures:
    """Measure every row, on one thread."""
    warnings.simplefilter("ignore")  # of the other libraries
    return {"samples": {str(n): compare(n) for n in options.samples}}


def tables(figures: Figures) -> list[Table]:
    """A row for each sampler and number of samples."""
    rows = []
    for n, found in figures["samples"].items():
        rates = {name: x["ess_per_s"] for name, x in found.items() if not isinstance(x, str)}
        best = max((rate for name, rate in rates.items() if "roadload" not in name and name != FLOOR), default=np.nan)
        for name, x in found.items():
            row = {"sampler": f"{name}, {int(n):,} samples", "ESS/s": rates.get(name, x)}
            for other, base in (("best peer", best), ("floor", rates[FLOOR])):
                row[f"/ {other}"] = rates[name] / base if name in rates else None
            moments = x["moments"] if name in rates else [None] * 3
            rows.append(row | dict(zip(PARAMETERS, moments, strict=True)))
    return [Table.of("", rows)]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the numbers of samples."""
    parser.add_argument("--samples", type=int, nargs="+", default=[1_000, 10_000, 100_000])


CHECK = Check(
    title="Samplers",
    measure=measure,
    tables=tables,
    headline=Cells(rows=(OURS,), columns=("/ best peer",)),
    options=add_options,
)

if __name__ == "__main__":
    if not ONE_THREAD.items() <= os.environ.items():
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | ONE_THREAD)
    sys.exit(CHECK.main())
