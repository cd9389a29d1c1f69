"""Fleet estimates for programs, in one process: logs in, a table out."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from estimator.columns import columns
from estimator.config import Config
from estimator.fleet.engine import Serial
from estimator.fleet.rows import drive_rows
from estimator.fleet.run import check, run_fleet
from estimator.fleet.sources import find_logs
from estimator.fleet.tables import DRIVES
from estimator.streaming.log_frames import kind_of


def estimate_drives(sources: Sequence[str | Path], config: Config, vehicle: str | None = None) -> dict[str, Any]:
    """Estimate logs in this process; returns a table of drives, as arrays (n,) by column.

    ``pandas.DataFrame`` and ``polars.DataFrame`` accept it. The columns are those of ``drives.parquet``; missing
    numbers are NaN. ``vehicle`` is a regular expression whose first group is the name of the vehicle in a path.

    Raises
    ------
    InputError
        A source is missing or has no log, or the configuration is invalid. An unreadable log is a row of the table.
    """
    check(config)
    logs = find_logs([str(source) for source in sources], vehicle, kind_of(config)).logs
    fleet = run_fleet(logs, config, Serial())
    return columns(DRIVES, drive_rows(fleet))
