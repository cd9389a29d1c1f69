"""The power of a diagnosis in a file: measured and modelled, the rows that its page draws and its figures are of."""

import csv
from io import StringIO
from pathlib import Path

from estimator.diagnosis.result import Traces
from estimator.output_files import check_suffix, whole

FORMATS = (".csv",)
COLUMNS = {  # heading, attribute of the traces, unit of it over the heading's
    "log": ("log", 1.0),
    "time_s": ("t", 1.0),
    "distance_km": ("distance", 1e3),
    "speed_km_h": ("speed", 1 / 3.6),
    "acceleration_m_s2": ("acceleration", 1.0),
    "measured_kW": ("measured", 1e3),
    "plain_kW": ("base", 1e3),
    "with_effects_kW": ("extended", 1e3),
    "road_known_kW": ("road_known", 1e3),
}


def write_traces(traces: Traces, path: Path) -> None:
    """Write a row for every mean over 2 s: time since the first frame of a log, speed, and power by each model.

    Raises
    ------
    ConfigError
        The name does not end in ``.csv``, or its folder is missing.
    RoadloadError
        The file cannot be written.
    """
    check_suffix(path, FORMATS)
    text = StringIO(newline="")
    table = csv.writer(text)
    table.writerow(COLUMNS)
    columns = [(getattr(traces, name) / unit).tolist() for name, unit in COLUMNS.values()]
    columns[0] = (traces.log + 1).tolist()  # as text and page number them
    table.writerows([f"{value:.7g}" for value in row] for row in zip(*columns, strict=True))
    with whole(path) as file:
        file.write(text.getvalue().encode())
