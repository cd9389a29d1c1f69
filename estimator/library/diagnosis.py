"""The diagnosis of drives as a notebook wants it."""

import html
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from estimator.answers.diagnosis import DiagnosisAnswer
from estimator.blas_threads import one_blas_thread
from estimator.config import Config
from estimator.diagnosis.diagnose import diagnose as diagnosed
from estimator.diagnosis.result import Diagnosis
from estimator.errors import InputError, RoadloadError
from estimator.extras import how_to_install
from estimator.library.reading import as_drives
from estimator.model.effects import CATALOGUE, Effect, named
from estimator.preparation.drive import Drive
from estimator.report import diagnosis_page, wording
from estimator.report.diagnosis_summary import of_diagnosis

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True, repr=False)
class DriveDiagnosis(Diagnosis):
    """A diagnosis with what a notebook asks of it; all of its figures are those of the page and the JSON."""

    @property
    def answer(self) -> DiagnosisAnswer:
        """The answer that ``roadload diagnose --json`` prints."""
        return of_diagnosis(self)

    def summary(self) -> str:
        """The verdict in two sentences."""
        return f"{wording.headline(self)} {wording.reason(self)}"

    def report(self, path: str | Path) -> None:
        """Write the page, which opens offline.

        Raises
        ------
        ConfigError
            The name does not end in ``.html``, or its folder is missing.
        """
        diagnosis_page.write_page(self, Path(path))

    def plot(self, kind: str = "power") -> "Figure":
        """A figure of matplotlib: ``"power"``, ``"gap"`` (the residual over the drive) or ``"budget"``.

        Raises
        ------
        InputError
            There is no such figure.
        RoadloadError
            The drive could not be fitted, or matplotlib is not installed.
        """
        try:
            from estimator.report import diagnosis_plots
        except ImportError as error:
            raise RoadloadError(f"plot needs matplotlib: {how_to_install('plot')}") from error
        if kind not in diagnosis_plots.KINDS:
            raise InputError(f"kind: {kind!r} is none of {', '.join(diagnosis_plots.KINDS)}")
        if self.traces is None:
            raise RoadloadError(f"there is no fit: {self.obstacle}")
        return diagnosis_plots.KINDS[kind](self)

    def __repr__(self) -> str:
        text = StringIO()
        print(f"{self.verdict.value}: {self.summary()}", file=text)  # to a text in memory
        for part in self.budget.parts if self.budget is not None else ():
            print(f"  {wording.label(part.cause):28} {wording.percent(part.share):>8}", file=text)
        return text.getvalue().rstrip("\n")

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(repr(self))}</pre>"


@one_blas_thread()
def diagnose(
    drives: Drive | Sequence[Drive],
    config: Config | None = None,
    *,
    further: Sequence[Effect] = (),
    surrogates: int = 0,
) -> DriveDiagnosis:
    """Where model and vehicle disagree, which effect causes it, how far the gap shrinks once that is added.

    Parameters
    ----------
    drives
        One drive, or several of one vehicle.
    config
        Settings, of which ``effects`` are given; None: those that the first drive was read with.
    further
        Effects that are candidates beside those of the catalogue.
    surrogates
        Records of noise alone in which effects are looked for as well, for a p-value.
    """
    given = as_drives(drives)
    settings = config or (given[0].config if given else Config())
    numbered = [replace(drive, log=i, log_start=drive.start) for i, drive in enumerate(given)]
    rng = np.random.default_rng(settings.sampler.seed)
    result = diagnosed(numbered, named(settings.effects), rng, (*CATALOGUE, *further), surrogates=surrogates)
    return DriveDiagnosis(**{each.name: getattr(result, each.name) for each in fields(Diagnosis)})
