"""Tables as arrays by column, which pandas and polars take."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimator.estimates import Marginal

Row = Mapping[str, Any]
STATISTICS = ("mean", "sd", "q05", "q95")
_FILL = {"text": "", "number": np.nan, "count": 0, "time": 0.0}
_TYPES = {"text": np.str_, "number": np.float64, "count": np.int64, "time": np.float64}


@dataclass(frozen=True)
class Column:
    """A column of a table: ``kind`` is "text", "number", "count" or "time"."""

    name: str
    kind: str
    unit: str = ""
    meaning: str = ""


EVIDENCE = (  # for an effect
    Column("probability", "number", "1"),
    Column("log_bayes_factor", "number", "1", "natural logarithm"),
    Column("magnitude", "text", meaning='quantity that is estimated; "slope": sd of a grade that signals show'),
    Column("value", "number", meaning="of the magnitude, in `unit`"),
    Column("sd", "number", meaning="of the magnitude, in `unit`"),
    Column("unit", "text"),
)


def posterior(name: str, unit: str, meaning: str) -> list[Column]:
    """The columns of a posterior, which `statistics` fills."""
    return [Column(f"{name}_{part}", "number", unit, f"{meaning}: {part}") for part in STATISTICS]


def statistics(name: str, found: Marginal | None) -> dict[str, float]:
    """The columns of a posterior; none where it is not estimated."""
    return {} if found is None else {f"{name}_{part}": getattr(found, part) for part in STATISTICS}


def columns(schema: Sequence[Column], rows: Sequence[Row]) -> dict[str, Any]:
    """Rows as arrays (n,) by column, which pandas and polars take.

    A number that is missing is NaN, a text that is missing is empty. Times are ``datetime64[us]``, UTC.
    """
    table: dict[str, Any] = {}
    for column in schema:
        values: Any = np.array([row.get(column.name, _FILL[column.kind]) for row in rows], dtype=_TYPES[column.kind])
        if column.kind == "time":
            values = np.round(values * 1e6).astype("datetime64[us]")
        table[column.name] = values
    return table
