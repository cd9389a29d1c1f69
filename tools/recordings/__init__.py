"""Real recordings as tables that the program reads, and clean drives with the noise of real ones."""

import csv
from collections.abc import Mapping
from pathlib import Path

from estimator.signals import Floats


def write_table(path: Path, columns: Mapping[str, Floats]) -> None:
    """Write columns (n,) under their names; NaN where there is no value."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))
