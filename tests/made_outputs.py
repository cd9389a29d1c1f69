"""Pictures and pages of made results, as a program: prints the name and the hash of each, a line each."""

import hashlib
import sys
from pathlib import Path

import numpy as np
from diagnoses import rich, several, unknown
from made_fleets import made
from test_fleet_page import page_of

from estimator.estimates import Convergence
from estimator.estimation.evidence import Evidence, Trace
from estimator.estimation.posterior import Posterior
from estimator.estimation.window import Grid
from estimator.report.diagnosis_page import page
from estimator.report.plots import write_plot

KINDS, DRAWINGS = ("svg", "pdf"), 2  # of pictures


def made_evidence(n: int = 300) -> Evidence:
    """What a picture is drawn of, with ``n`` strides."""
    rng = np.random.default_rng(1)
    v = 10 + 5 * np.sin(np.arange(n) / 20)
    a = np.gradient(v)
    power = 2e4 + 2.7e3 * v * a
    grid = Grid(0.5, 0.1)
    t = np.arange(float(n))
    trace = Trace(t=t, v=v, a=a, P=power, fitted=power + rng.normal(0, 100, n), density=np.full(n, 1.2), spacing=1.0)
    draws = np.array([1300, 3.5, 20e3]) + rng.standard_normal((8, 100, 3)) * [50, 0.1, 200]
    return Evidence(
        trace=trace,
        posterior=Posterior(draws, Convergence(r_hat=1.0, ess_bulk=800.0, acceptance=0.5, draws=100, chains=8)),
        lag=0.1,
        grid=grid,
        counts=np.bincount(grid.cell(v, a), minlength=grid.size),
        rms=3e3,
        effective=float(n),
    )


def main(folder: Path) -> None:
    """Draw everything, with files in a folder."""
    pages = {"rich": page(rich()), "several": page(several()), "unknown": page(unknown())}
    pages["fleet"] = page_of(made(3, 6, 1, outlier="truck-02", with_diagnosis=True).fleet)
    contents = {name: text.encode("utf-8", "replace") for name, text in pages.items()}
    for suffix in KINDS:
        for number in range(DRAWINGS):
            path = folder / f"{number}.{suffix}"
            write_plot(made_evidence(), "a title", path)
            contents[path.name] = path.read_bytes()
    for name, content in contents.items():
        sys.stdout.write(f"{name} {hashlib.sha256(content).hexdigest()}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
