"""Pictures and pages of made results, as a program: prints the name and the hash of each, a line each."""

import hashlib
import sys
from pathlib import Path

import numpy as np
from diagnoses import rich, several, unknown
from made_fleets import made, page_of

from estimator.answers.run import CoverageMap
from estimator.estimates import Convergence, Coverage, Estimate, Marginal, Status
from estimator.estimation.evidence import Evidence, Trace
from estimator.estimation.posterior import Posterior
from estimator.estimation.window import Grid
from estimator.report.diagnosis_page import page
from estimator.report.estimate_page import page as estimate_page
from estimator.report.estimate_view import EstimateView
from estimator.report.plots import write_plot

FIRST = 1_700_000_000.0  # s, time of the first frame
KINDS = ("svg", "pdf")  # of pictures


def made_evidence(n: int = 300) -> Evidence:
    """What a picture is drawn of, with ``n`` strides."""
    rng = np.random.default_rng(1)
    v = 10 + 5 * np.sin(np.arange(n) / 20)
    a = np.gradient(v)
    power = 2e4 + 2.7e3 * v * a
    grid = Grid(0.5, 0.1)
    t = FIRST + np.arange(float(n)) + 60.0 * (np.arange(n) > n // 3)  # with a stop
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


def made_view(updates: int = 12, title: str = "a title") -> EstimateView:
    """An estimate that narrows over ``updates``, the first of which knows the mass alone."""
    evidence = made_evidence()
    trace, grid = evidence.trace, evidence.grid
    rms = float(np.sqrt(np.mean((trace.P - trace.fitted) ** 2)))

    def narrowing(i: int, k: int) -> Marginal:
        known = evidence.posterior.marginal(i)
        sd = known.sd * updates / (k + 1)
        mean = known.mean + (updates - k - 1) * known.sd / 3
        return Marginal(mean=mean, sd=sd, q05=mean - 1.645 * sd, q50=mean, q95=mean + 1.645 * sd)

    def update(k: int) -> Estimate:
        is_whole = k > 0
        return Estimate(
            t=FIRST + 25.0 * (k + 1),
            status=Status.ESTIMATED,
            reason="",
            coverage=Coverage(6, 9, (1, 2)),
            admitted=3000,
            mass=narrowing(2, k),
            A=narrowing(0, k) if is_whole else None,
            C=narrowing(1, k) if is_whole else None,
            convergence=evidence.posterior.convergence,
            rms=rms,
            withheld={} if is_whole else {"A": "too uncertain <yet>", "C": "too uncertain"},
            c_rr=evidence.posterior.c_rr if is_whole else None,
            air_density=trace.mean_density,
        )

    cells = CoverageMap(
        speed_step_m_s=grid.speed_step,
        acceleration_step_m_s2=grid.acceleration_step,
        lowest_acceleration_m_s2=-1.0,
        needed=10,
        rows=((20, 9, 3), (20, 10, 40), (21, 11, 800)),
        wanted=((22, 12), (23, 12)),
    )
    return EstimateView(
        title=title,
        start=FIRST,
        updates=tuple(update(k) for k in range(updates)),
        cells=cells,
        evidence=evidence,
        warnings=("a <warning>",),
    )


def hashes(folder: Path) -> dict[str, str]:
    """Draw everything, with files in a folder; the hash of each by name."""
    pages = {"rich": page(rich()), "several": page(several()), "unknown": page(unknown())}
    pages["estimate"] = estimate_page(made_view())
    pages["fleet"] = page_of(made(3, 6, 1, outlier="truck-02", with_diagnosis=True).fleet)
    contents = {name: text.encode("utf-8", "replace") for name, text in pages.items()}
    for suffix in KINDS:
        path = folder / f"estimate.{suffix}"
        write_plot(made_view(), path)
        contents[path.name] = path.read_bytes()
    return {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}


if __name__ == "__main__":
    sys.stdout.write("".join(f"{name} {value}\n" for name, value in hashes(Path(sys.argv[1])).items()))
