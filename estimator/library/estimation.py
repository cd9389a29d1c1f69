"""The estimate of a drive as a notebook wants it."""

import html
from collections.abc import Sequence
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from estimator.answers.run import CoverageMap
from estimator.blas_threads import one_blas_thread
from estimator.config import Config
from estimator.errors import RoadloadError
from estimator.estimates import PARAMETERS, Estimate, Marginal, Status
from estimator.estimation.estimator import Estimator
from estimator.estimation.evidence import Evidence
from estimator.extras import how_to_install
from estimator.library.reading import as_drives
from estimator.preparation.drive import Drive
from estimator.report import export, summary
from estimator.report.estimate_page import write_page
from estimator.report.estimate_text import lines_of
from estimator.report.estimate_view import EstimateView

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAMES = {"mass": "mass [kg]", "A": "A [N]", "C": "C [N s²/m²]"}


@dataclass(frozen=True, kw_only=True, repr=False)
class Estimation:
    """Mass, A and C of a vehicle from its drives, with all that led to them.

    ``final``: the last estimate, of which ``mass``, ``A`` and ``C`` are the marginals; ``updates``: all, in order of
    time; ``start``: time of the first frame [s]; ``cells``: the coverage map; ``evidence``: trace and draws behind the
    last one, None where it has no values; ``rejected``: rows not used, by reason.
    """

    final: Estimate
    updates: tuple[Estimate, ...]
    start: float
    cells: CoverageMap
    evidence: Evidence | None = field(default=None)
    rejected: dict[str, int]

    @property
    def status(self) -> Status:
        """Whether there is an estimate."""
        return self.final.status

    @property
    def reason(self) -> str:
        """Why there is none; empty where there is."""
        return self.final.reason

    @property
    def mass(self) -> Marginal | None:
        """Moving mass, rotating parts included [kg]; None where it is not estimated."""
        return self.final.mass

    @property
    def A(self) -> Marginal | None:
        """Rolling and friction force [N]."""
        return self.final.A

    @property
    def C(self) -> Marginal | None:
        """Aerodynamic coefficient [N s^2/m^2]."""
        return self.final.C

    def summary(self) -> dict[str, list[Any]]:
        """A row for each parameter, as columns: name, mean, sd, q05, q50, q95, status, reason.

        ``pandas.DataFrame`` and ``polars.DataFrame`` take it. Numbers that are missing are NaN.
        """
        marginals, statuses = self.final.marginals, [self.final.status_of(name) for name in PARAMETERS]
        rows: dict[str, list[Any]] = {"parameter": ["A [N]", "C [N s2/m2]", "mass [kg]"]}
        for key in ("mean", "sd", "q05", "q50", "q95"):
            values = (marginals[name] for name in PARAMETERS)
            rows[key] = [np.nan if value is None else getattr(value, key) for value in values]
        rows["status"] = [status.value for status, _ in statuses]
        rows["reason"] = [reason for _, reason in statuses]
        return rows

    def to_dict(self) -> dict[str, Any]:
        """The last estimate as plain numbers and texts."""
        found: dict[str, Any] = msgspec.to_builtins(self.final)
        return found

    def to_arviz(self) -> Any:
        """Draws of A, C and mass as a tree of ArviZ (`arviz_base.from_dict`), chain by chain.

        Raises
        ------
        RoadloadError
            There is no estimate.
        ConfigError
            arviz-base is not installed.
        """
        return export.arviz_tree(self._evidence().posterior, self.final.withheld)

    def plot(self, title: str = "roadload") -> "Figure":
        """A figure of matplotlib: the answer, how it formed, coverage, power with its residual, posterior.

        Raises
        ------
        RoadloadError
            There is no estimate, or matplotlib is not installed.
        """
        self._evidence()
        try:
            from estimator.report import plots
        except ImportError as error:
            raise RoadloadError(f"plot needs matplotlib: {how_to_install('plot')}") from error
        return plots.draw(self._view(title))

    def report(self, path: str | Path, title: str = "roadload") -> None:
        """Write the page of `roadload estimate --plot OUT.html`, which opens offline.

        Raises
        ------
        ConfigError
            The name does not end in ``.html``, or its folder is missing.
        RoadloadError
            The file cannot be written.
        """
        write_page(self._view(title), Path(path))

    def _view(self, title: str) -> EstimateView:
        return EstimateView(
            title=title, start=self.start, updates=self.updates, cells=self.cells, evidence=self.evidence
        )

    def _evidence(self) -> Evidence:
        if self.evidence is None:
            raise RoadloadError(f"there is no estimate: {self.final.reason}")
        return self.evidence

    def __repr__(self) -> str:
        text = StringIO()
        for line in lines_of(self.final, self.rejected):
            print(line, file=text)  # to a text in memory
        return text.getvalue().rstrip("\n")

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(repr(self))}</pre>"


@one_blas_thread()
def estimate(drives: Drive | Sequence[Drive], config: Config | None = None) -> Estimation:
    """Mass, rolling resistance and drag from one drive, or from several of one vehicle in order of time.

    Parameters
    ----------
    drives
        As `read` or `from_table` gives them.
    config
        Settings; None: those that the first drive was read with.
    """
    given = as_drives(drives)
    settings = config or (given[0].config if given else Config())
    estimator, updates = Estimator(settings, np.random.default_rng(settings.sampler.seed)), list[Estimate]()
    for number, drive in enumerate(given):
        if number:
            estimator.forget()
        for piece in drive.pieces:
            updates += estimator.feed(piece)
            updates += estimator.finish()
    if not updates:
        raise RoadloadError("there is no driving in it")
    return Estimation(
        final=updates[-1],
        updates=tuple(updates),
        start=given[0].log_start,
        cells=summary.coverage_map(estimator.window, settings.gate, updates[-1]),
        evidence=estimator.evidence,
        rejected=dict(estimator.rejected),
    )
