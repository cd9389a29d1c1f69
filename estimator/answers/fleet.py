"""The answer of `fleet`; the tables have everything else."""

from estimator.answers.answer import Answer


class FleetAnswer(Answer, frozen=True, kw_only=True):
    """Counts of drives, of rows by status and of vehicles; parameters out of line by vehicle; the files written.

    ``left_out`` counts files that are logs with other settings only: tables without ``--map``, or frames with it.
    """

    drives: int
    rows: dict[str, int]
    vehicles: int
    vehicles_estimated: int
    outliers: dict[str, str]
    files: tuple[str, ...]
    left_out: int = 0
