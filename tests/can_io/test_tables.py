"""Tables of measurements: what they give, against the log of the same drive, and what is refused in one line."""

import csv
import errno
import gzip
import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_logs import TRUCK, ask, drive, written

from estimator import config as configuration
from estimator import estimate, from_table, read
from estimator.can_io.bound_traffic import bound_messages
from estimator.can_io.logs import table_text
from estimator.can_io.logs.table import SAME_TIME, SHORT, SUFFIXES, TableLog
from estimator.can_io.logs.table_times import SameTimes
from estimator.can_io.table_columns import columns_of, seconds_in, split_unit
from estimator.commands.log_options import table_of
from estimator.commands.main import main
from estimator.config import Config, from_dict
from estimator.errors import ConfigError, LogError, RoadloadError
from estimator.library.estimation import Estimation
from estimator.samples import STEP, Rows
from estimator.settings import Table, Vehicle
from estimator.signals import Role

MAP = ["--map", "speed=v [km/h]", "--map", "power=P [kW]", "--map", "time=t [s]"]
FRACTION = ["--map", "speed=v [km/h]", "--map", "torque_fraction=P [%]", "--map", "time=t [s]"]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(drive("mixed", 8, 4), tmp_path_factory.mktemp("drive") / "drive.blf")


@pytest.fixture(scope="module")
def table(log: Path) -> dict[str, np.ndarray]:
    """The rows of the drive, ten a second, NaN where speed or power is not known."""
    rows = Rows.concatenate(*read(log).pieces)
    return {
        "t": rows.t - rows.t[0],
        "v": 3.6 * rows.speed,
        "P": rows.power / 1e3,
        "h": rows.context[Role.ALTITUDE],
        "brake": rows.context[Role.BRAKE_SWITCH],
    }


def written_table(columns: Mapping[str, Sequence[Any] | np.ndarray], path: Path, delimiter: str = ",") -> Path:
    path.parent.mkdir(exist_ok=True, parents=True)
    opened = gzip.open if path.suffix == ".gz" else open
    with opened(path, "wt", newline="") as file:
        writer = csv.writer(file, delimiter=delimiter)
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow("" if value != value else value for value in row)
    return path


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line of a refusal."""
    assert main([*map(str, arguments)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def alike(one: Estimation, other: Estimation, sds: float) -> None:
    for name in ("mass", "A", "C"):
        a, b = getattr(one, name), getattr(other, name)
        assert a.mean == pytest.approx(b.mean, abs=sds * b.sd)


@pytest.mark.slow
def test_a_table_gives_what_the_log_of_the_same_drive_gives(log: Path, table: dict[str, np.ndarray]) -> None:
    """Its rows are those of the log, taken as readings: means of means over a row, so not to the last digit."""
    from_log = estimate(read(log))
    made = from_table(table, speed="v [km/h]", power="P [kW]", altitude="h [m]", brake_switch="brake")
    alike(estimate(made), from_log, 1.0)


@pytest.mark.slow
def test_a_file_gives_the_same_numbers_as_arrays(table: dict[str, np.ndarray], tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {"speed": "v [km/h]", "power": "P [kW]", "brake_switch": "brake"}
    made = from_table(table, **columns)
    (expected,) = made.pieces
    pq.write_table(pa.table(table), tmp_path / "drive.parquet")
    files = [
        written_table(table, tmp_path / "drive.csv"),
        written_table(table, tmp_path / "drive.tsv", "\t"),
        written_table(table, tmp_path / "semicolons.csv.gz", ";"),
        tmp_path / "drive.parquet",
    ]
    for file in files:
        (rows,) = read(file, columns=columns).pieces
        np.testing.assert_array_equal(rows.index, expected.index)
        np.testing.assert_array_equal(rows.speed, expected.speed)
        np.testing.assert_array_equal(rows.power, expected.power)
        assert rows.context.keys() == expected.context.keys()
        for role, values in expected.context.items():
            np.testing.assert_array_equal(rows.context[role], values)
    answer = ask("estimate", files[0], *MAP, "--map", "brake_switch=brake")
    mass = estimate(made).mass
    assert mass is not None
    assert answer["parameters"]["mass_kg"]["mean"] == mass.mean


@pytest.mark.slow
def test_a_data_frame_and_a_force_do_as_well(table: dict[str, np.ndarray]) -> None:
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(table)
    by_power = estimate(from_table(frame, speed="v", power="P", units={"v": "km/h", "P": "kW"}))
    moving = frame["v"] > 1.0
    frame["F"] = np.where(moving, frame["P"] / np.where(moving, frame["v"] / 3.6, 1.0), 0.0)
    alike(estimate(from_table(frame, speed="v [km/h]", force="F [kN]")), by_power, 0.3)


@pytest.mark.slow
def test_dates_are_times(table: dict[str, np.ndarray], tmp_path: Path) -> None:
    start = np.datetime64("2026-05-04T06:00:00")
    dated = {**table, "t": start + (1000 * table["t"]).astype("timedelta64[ms]")}
    columns = {"speed": "v [km/h]", "power": "P [kW]"}
    (expected,) = from_table(dated, time="t", **columns).pieces
    file = written_table({**dated, "t": [str(t) for t in dated["t"]]}, tmp_path / "dated.csv")
    (by_text,) = read(file, columns={**columns, "time": "t"}).pieces
    (undated,) = from_table(table, **columns).pieces
    assert expected.t[0] == pytest.approx(start.astype("datetime64[s]").astype(float) + undated.t[0], abs=STEP)
    assert undated.t[-1] - undated.t[0] == pytest.approx(expected.t[-1] - expected.t[0], abs=STEP)
    np.testing.assert_allclose(by_text.t, expected.t, rtol=0.0, atol=1e-6)
    for rows, lateness in ((expected, 2e-7), (undated, 1e-3)):  # s, of a float of an epoch, and of a whole millisecond
        np.testing.assert_allclose(by_text.speed, rows.speed, rtol=0.0, atol=2.0 * lateness)  # speeds up by 2 m/s²


def test_what_a_configuration_says_of_a_table_is_used(tmp_path: Path) -> None:
    config = from_dict({"table": {"time": "t [ms]", "columns": {"speed": "v [m/s]", "power": "P [W]"}}})
    n = 300
    file = written_table({"t": 100.0 * np.arange(n), "v": np.full(n, 20.0), "P": np.full(n, 5e4)}, tmp_path / "a.csv")
    made = read(file, config)
    (rows,) = made.pieces
    assert len(rows) == pytest.approx(n, abs=3)
    assert (rows.speed[50], rows.power[50]) == pytest.approx((20.0, 5e4))


def test_what_a_warning_says_of_states_and_ranges_of_a_table_works(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same spelling as in the table of inputs; another one is refused with those that there are."""
    columns = steady(1200, brake=[1.0] * 1200, v=[50.0 + i % 9 for i in range(1200)])
    file, config = written_table(columns, tmp_path / "a.csv"), tmp_path / "a.toml"
    table = '[table]\ncolumns = { speed = "v [km/h]", power = "P [kW]", brake_switch = "brake" }\n[bus]\n'

    def inspected(line: str) -> Any:
        config.write_text(table + line)
        assert main(["inspect", str(file), "--config", str(config), "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    (warning,) = inspected("")["warnings"]
    (line,) = re.findall(r"\[bus\] (states = .*)", warning)
    assert line == 'states = { "brake_switch.brake" = [0] }'
    answer = inspected(line)
    assert (answer["warnings"], answer["inputs"]["brake_switch"]["maximum"]) == ([], 0.0)
    assert inspected('units = { "engine_power.P" = "W" }')["inputs"]["engine_power"]["maximum"] == 50.0
    answer = inspected('ranges = { "speed.v" = [0, 54] }')
    assert answer["inputs"]["speed"]["maximum"] == pytest.approx(15.0)
    assert 'write [bus] ranges = { "speed.v" = [lowest, highest] }' in answer["warnings"][0]
    config.write_text(table + "states = { brake = [0] }")
    said = "bus.states.brake: no signal of that name is bound; bound are brake_switch.brake, engine_power.P, speed.v"
    assert said in refused(capsys, "inspect", file, "--config", config)
    config.write_text('[bus]\nstates = { "brake_switch.brake" = [0] }')
    arguments = ["--config", str(config), *MAP, "--map", "brake_switch=brake", "--json"]
    assert main(["inspect", str(file), *arguments]) == 0
    assert json.loads(capsys.readouterr().out)["warnings"] == []


def steady(n: int = 200, **changes: Any) -> dict[str, Any]:
    return {"t": (np.arange(n) / 10).tolist(), "v": [72.0] * n, "P": [50.0] * n, **changes}


@pytest.mark.parametrize(
    ("columns", "arguments", "said"),
    [
        (steady(t=[0.1 * (i % 150) for i in range(200)]), MAP, "row 151: time steps back from 14.9 to 0 s; sort"),
        (steady(t=[float(i // 2) for i in range(200)]), MAP, "rows 1 and 2 have one time, and so have half"),
        (steady(t=[10.0 * i for i in range(200)]), MAP, "has a row every 10 s; the mass follows from"),
        (steady(v=["72"] * 20 + ["fast"] + ["72"] * 179), MAP, "row 21, column 'v': 'fast' is no number; correct"),
        (steady(t=["0.1"] * 5 + [""] + ["0.2"] * 194), MAP, "row 6: has no time; fill it in, or delete the row"),
        (steady(), ["--map", "speed=v", "--map", "power=P"], 'speed = "v" has no unit; write it in brackets'),
        (steady(), ["--map", "speed=v [W]", "--map", "power=P [kW]"], 'speed = "v [W]" needs one of the units km/h'),
        (steady(), ["--map", "speed=w [m/s]", "--map", "power=P [kW]"], "has no column 'w'; there are 't', 'v', 'P'"),
        (steady(), ["--map", "sped=v [m/s]"], "table.columns.sped: no such role; did you mean speed?"),
        (steady(), ["--map", "velocity_of_it=v [m/s]"], "table.columns.velocity_of_it: no such role; the roles are "),
        (steady(), ["--map", "speed"], '--map speed: write ROLE="COLUMN [unit]"'),
        (steady(w=[20.0] * 200), [*MAP, "--map", "speed=w [m/s]"], "has the columns 'v' and 'w', each given for speed"),
        (steady(), [*MAP, "--map", "speed=v [m/s]"], "table.alternatives.speed: the column 'v' is given twice; leave"),
        (steady(), [*MAP, "--map", "time = t [ms]"], "table.alternatives.time: the column 't' is given twice; leave"),
        (steady(), [*MAP, "--map", "speed=w"], 'speed = "w" has no unit; write it in brackets'),
        (
            steady(),
            [*MAP, "--map", "grade=slope [deg]", "--map", "grade=Steigung [%]"],
            'table.alternatives.grade: "slope [deg]" and "Steigung [%]" are of two kinds; give one of them',
        ),
        (
            steady(),
            [*MAP[:4], "--map", "time=Zeit", "--map", "time=Time"],
            "has no column 'Zeit' or 'Time'; there are 't', 'v', 'P'; where files name it differently, repeat --map ",
        ),
        (
            steady(),
            ["--map", "speed=w [m/s]", "--map", "speed=x [km/h]", "--map", "power=P [kW]"],
            "has no column 'w' or 'x'; there are 't', 'v', 'P'; where files name it differently, repeat --map speed=",
        ),
        (steady(), ["--map", " speed = v "], 'speed = "v" has no unit; write it in brackets'),
        (
            steady(),
            ["--map", "power=P [kW]"],
            "missing inputs: speed; give them columns with numbers, as in --map speed=",
        ),
        (steady(v=[1e308] * 200), MAP, "missing inputs: speed.v; give them columns with numbers, as in --map speed="),
        (steady(v=["nan"] * 200, P=["nan"] * 200), MAP, "no row with a number in it (nothing at all)"),
        (
            steady(v=["inf"] * 200, P=["nan"] * 200),
            MAP,
            "missing inputs: speed.v, engine_power.P; give them columns",
        ),
        (
            steady(rpm=[1200.0] * 200),
            [*FRACTION, "--map", "engine_speed=rpm [rpm]"],
            "missing inputs: reference_torque; start the configuration (--config FILE.toml) with "
            "vehicle.reference_torque_Nm = ... (reference torque of the engine, SPN 544)",
        ),
        (
            steady(),
            FRACTION,
            "missing inputs: engine_speed, reference_torque; start the configuration (--config FILE.toml) with "
            "vehicle.reference_torque_Nm = ... (reference torque of the engine, SPN 544); give the others columns",
        ),
        (steady(v=["72"] * 20 + ["1_000"] + ["72"] * 179), MAP, "row 21, column 'v': '1_000' is no number; correct"),
        (steady(t=["0.1"] * 5 + ["1_0"] + ["0.2"] * 194), MAP, "row 6, column 't': '1_0' is no number; correct it"),
        (steady(), [*MAP[:4], "--map", "time=t [fortnights]"], "the unit 'fortnights' of the times is not known"),
        ({"1.0": [1.0] * 9, "2.0": [2.0] * 9}, MAP, "line 1 names no columns ('1.0, 2.0'); put a line of names first"),
    ],
)
def test_bad_tables_are_refused_in_one_line(
    columns: dict[str, Any], arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = refused(capsys, "estimate", written_table(columns, tmp_path / "bad.csv"), *arguments)
    assert said in line


def columns_read(text: str, path: Path, encoding: str = "utf-8") -> dict[str, list[str]]:
    path.write_bytes(text.encode(encoding))
    (piece,) = table_text.read(path, set)
    return {name: list(cells) for name, cells in piece.cells.items()}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_table_as_a_spreadsheet_of_another_country_writes_it(encoding: str, tmp_path: Path) -> None:
    text = "t;v;P\r\n0,0;72,5;-1\r\n0,1;72,6;50\r\n"
    expected = {"t": ["0.0", "0.1"], "v": ["72.5", "72.6"], "P": ["-1", "50"]}
    assert columns_read(text, tmp_path / "a.csv", encoding) == expected


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_line_that_gives_the_separator_comes_before_the_names(encoding: str, tmp_path: Path) -> None:
    """As Excel takes it; numbers of lines count it."""
    text = "t;v, front, left, mean;P\r\n0,0;72,5;-1\r\n0,1;72,6;50\r\n"
    expected = {"t": ["0.0", "0.1"], "v, front, left, mean": ["72.5", "72.6"], "P": ["-1", "50"]}
    for line in ("sep=;\r\n", "SEP=;\n"):
        assert columns_read(line + text, tmp_path / "a.csv", encoding) == expected
    for line in ("sep=,\r\n", "sep=\t\n"):
        with pytest.raises(LogError, match=r"line 2 "):
            columns_read(line + text, tmp_path / "a.csv", encoding)
    for rows, said in (
        ("1;2;3;4\n", "row 1 has 4 cells, line 2 has 3 names"),
        ('"1;2;3\n1;2;3\n', "line 3 has a quote"),
    ):
        with pytest.raises(LogError, match=said):
            columns_read("sep=;\nt;v;P\n" + rows, tmp_path / "a.csv", encoding)


def test_a_cell_that_is_infinite_and_a_row_that_is_short_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The last row is cut within its speed; the rows after a short one keep their numbers."""
    rows = [f"{i / 10},{50 + i % 9},50\n" for i in range(200)]
    rows[3], rows[7], rows[-1] = "0.3,inf,50\n", "0.7,50\n", "19.9,7"
    (tmp_path / "a.csv").write_text("t,v,P\n" + "".join(rows))
    assert main(["inspect", str(tmp_path / "a.csv"), *MAP, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["frames"]["errors"] == {SHORT: 2, "speed.v: not a number": 1}
    assert found["inputs"]["speed"]["minimum"] == pytest.approx(50 / 3.6)
    rows[9] = "0.9,fast,50\n"
    (tmp_path / "a.csv").write_text("t,v,P\n" + "".join(rows))
    assert "row 10, column 'v': 'fast' is no number" in refused(capsys, "inspect", tmp_path / "a.csv", *MAP)


def rows_of_text(heading: str, tail: str, path: Path) -> Path:
    """A table of 200 rows, of a time, a speed and the ``tail``."""
    path.write_text(heading + "\n" + "".join(f"{i / 10},{50 + i % 9}{tail}\n" for i in range(200)))
    return path


@pytest.mark.parametrize("full", [0, 15])
def test_empty_cells_at_the_end_of_rows_may_be_left_out(full: int, tmp_path: Path) -> None:
    """Of all rows, or of all but the first ones, as of spreadsheets; a row that is cut is still left out."""
    lines = rows_of_text("t,v,P,x,y", ",50", tmp_path / "a.csv").read_text().splitlines()
    lines[1 : 1 + full] = [f"{line},," for line in lines[1 : 1 + full]]
    lines[-1] = "19.9,7"
    (tmp_path / "a.csv").write_text("\n".join(lines))
    log = TableLog(tmp_path / "a.csv", Table(columns=RATES))
    assert sum(map(len, log)) == 2 * 199
    assert log.skipped == {SHORT: 1}
    (rows,) = read(tmp_path / "a.csv", columns=RATES).pieces
    assert np.nanmin(rows.speed) > 49 / 3.6


@pytest.mark.parametrize(
    ("heading", "tail", "said"),
    [
        ("t,v,P", "", "line 1 has 3 names, but no row has more than 2 cells, so column 'P' is empty; fill it in, or"),
        ("v,P,t", "", "line 1 has 3 names, but no row has more than 2 cells, so column 't' is empty; fill it in, or"),
        ("t,v,x [a, b],P,y", ",1,50,2", "and 'x [a' seems to be part of a name; put the name into quotes"),
        ("t,v,x (a, b),P,y", ",1,50,2", "and 'x (a' seems to be part of a name; put the name into quotes"),
    ],
)
def test_a_wanted_column_without_a_cell_and_names_beside_other_columns_are_refused(
    heading: str, tail: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = refused(capsys, "estimate", rows_of_text(heading, tail, tmp_path / "a.csv"), *MAP[:4])
    assert line.startswith(f"error: {tmp_path / 'a.csv'}: line 1 has ")
    assert said in line


def test_commas_beside_decimal_points_are_not_taken_for_decimal_commas(tmp_path: Path) -> None:
    assert columns_read("t\tn\n0.1\t1,234\n", tmp_path / "a.tsv") == {"t": ["0.1"], "n": ["1,234"]}


def test_a_point_of_thousands_is_refused_where_it_stands(tmp_path: Path) -> None:
    """The commas of all other rows were refused, from the first one on; with a comma behind it, its text changed."""
    rows = [f"{i},0;950,5\n" for i in range(9)]
    rows[4] = "4,0;1.050\n"
    with pytest.raises(LogError, match=r"row 5: '1\.050' has a point beside decimal commas; write it without"):
        columns_read("t;P\n" + "".join(rows), tmp_path / "a.csv")
    rows[4] = "4,0;1.050,5\n"
    assert columns_read("t;P\n" + "".join(rows), tmp_path / "a.csv")["P"][3:6] == ["950.5", "1.050,5", "950.5"]


def test_a_table_that_must_not_be_read_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = written_table(steady(), tmp_path / "a.csv")

    def refuse(self: Path, *_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(self))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(LogError, match=r"a\.csv: cannot be read \(Permission denied\); check its permissions"):
        read(file, columns=RATES)


@pytest.mark.parametrize("command", ["inspect", "estimate", "diagnose"])
def test_a_channel_of_a_table_is_refused(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = written_table(steady(), tmp_path / "a.csv")
    line = refused(capsys, command, file, *MAP, "--channel", "can1")
    said = "is read as a table, which has no channels; take out --channel, or bus.channels"
    assert line == f"error: {file}: {said}"


def test_check_takes_the_columns_of_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = written_table(steady(1200), tmp_path / "a.csv")
    advice = refused(capsys, "check", file)
    assert "give its columns to estimate, inspect, check, diagnose or fleet: --map " in advice
    assert main(["check", str(file), *MAP]) == 0
    assert "the model can be fed" in capsys.readouterr().out


def test_a_quote_that_is_not_closed_does_not_hide_the_rows_after_it(tmp_path: Path) -> None:
    rows = [f"{i},{i},\n" for i in range(100)]
    rows[40] = '40,40,"3 inch\n'
    with pytest.raises(LogError, match=r"t\.csv: line 42 has a quote that is not closed"):
        columns_read("t,v,remark\n" + "".join(rows), tmp_path / "t.csv")
    rows[43] = '43,43,"4 inch\n'
    with pytest.raises(LogError, match=r"t\.csv: line 42 has a quote that is not closed"):
        columns_read("t,v,remark\n" + "".join(rows), tmp_path / "t.csv")
    with pytest.raises(LogError, match=r"t\.csv: line 2 has a quote that is not closed"):
        columns_read('t,v,remark\n0,0,"\n' + "0,0,\n" * 20_000, tmp_path / "t.csv")
    rows[40], rows[43] = '40,40,"two\nlines"\n', '43,43,"' + 30 * "many, \n" + '"\n'
    assert columns_read("t,v,remark\n" + "".join(rows), tmp_path / "t.csv")["t"] == [str(i) for i in range(100)]


@pytest.mark.parametrize("role", ["power", "force"])
def test_a_driveline_beside_a_power_at_the_wheels_is_refused(role: str) -> None:
    table = Table(columns={"speed": "v [m/s]", role: "P [N]" if role == "force" else "P [kW]"})
    settings = Config(table=table, vehicle=Vehicle(driveline_efficiency=0.9))
    with pytest.raises(ConfigError, match=f"driveline_efficiency: the table's {role} is that at the wheels"):
        bound_messages(settings)


def test_a_row_with_more_cells_than_names_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RoadloadError, match="row 2 has 4 cells, line 1 has 2 names; correct that row, or write"):
        columns_read("t,v\n0,72,,\n0,1,72,5\n", tmp_path / "a.csv")


def test_masked_values_are_not_known() -> None:
    """A mask hides what stands in its place: here a speed of 650 km/h."""
    columns = {name: np.array(values, float) for name, values in steady().items()}
    hidden = np.arange(200) < 100
    columns["v"] = np.ma.masked_array(np.where(hidden, 650.0, columns["v"]), mask=hidden)
    (rows,) = from_table(columns, speed="v [km/h]", power="P [kW]").pieces
    known = rows.speed[np.isfinite(rows.speed)]
    assert 90 < len(known) < 110
    np.testing.assert_allclose(known, 20.0)


def test_a_column_of_several_values_a_row_and_a_missing_date_are_refused() -> None:
    columns = {name: np.array(values, float) for name, values in steady().items()}
    roles = {"speed": "v [km/h]", "power": "P [kW]"}
    with pytest.raises(RoadloadError, match="column 'v' holds 2 values a row; give one column for each"):
        from_table({**columns, "v": np.column_stack([columns["v"], columns["v"]])}, **roles)
    t = np.datetime64("2026-05-04T06:00") + (1000 * columns["t"]).astype("timedelta64[ms]")
    t[5] = np.datetime64("NaT")
    with pytest.raises(RoadloadError, match="row 6: has no time; fill it in, or delete the row"):
        from_table({**columns, "t": t}, **roles)


@pytest.mark.slow
@pytest.mark.parametrize("rows", [0, 1, 10, 5000])
def test_a_table_that_says_too_little_is_unestimated_or_refused(
    rows: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ten rows, or a constant speed."""
    file = written_table(steady(rows), tmp_path / "short.csv")
    status = main(["estimate", str(file), *MAP])
    said = capsys.readouterr()
    assert (status, len(said.err.splitlines())) == (2, 1) if status else "unestimated" in said.out
    assert "Traceback" not in said.err


@pytest.mark.parametrize("unit", ["knots", "mph", "m/s"])
def test_units_of_speed(unit: str) -> None:
    """A speed of 20 m/s in each of them, and a power in horse-power."""
    factor = {"knots": 3600 / 1852, "mph": 3600 / 1609.344, "m/s": 1.0}[unit]
    columns = {"t": np.arange(300) / 10, "v": np.full(300, 20 * factor), "P": np.full(300, 100.0)}
    (rows,) = from_table(columns, speed=f"v [{unit}]", power="P [hp]").pieces
    assert rows.speed[50] == pytest.approx(20.0)
    assert rows.power[50] == pytest.approx(74_569.99, rel=1e-6)


@settings(max_examples=200, deadline=None)
@given(st.text(max_size=20), st.text(alphabet=st.characters(exclude_characters="[]"), max_size=8))
def test_the_unit_is_what_stands_in_the_last_brackets(name: str, unit: str) -> None:
    assert split_unit(f"{name.strip()}x [{unit}]") == (f"{name.strip()}x", unit)


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=400))
def test_any_bytes_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    file = tmp_path_factory.mktemp("any") / "any.csv"
    file.write_bytes(b"t,v,P\n" + content)
    reason = ""
    try:
        made = read(file, columns={"speed": "v [m/s]", "power": "P [W]"})
    except RoadloadError as error:
        reason = str(error)
    assert "\n" not in reason
    assert reason or made.pieces


@pytest.mark.slow
@pytest.mark.usefixtures("without_workers")
def test_tables_of_one_vehicle_are_a_fleet(log: Path, tmp_path: Path) -> None:
    """Two drives as tables, in a folder of the vehicle beside a file that is none."""
    pq = pytest.importorskip("pyarrow.parquet", reason="the extra `fleet` is not installed")
    start = 0.0
    for name, other in (("1.csv", log), ("2.csv", written(drive("mixed", 8, 5), tmp_path / "other.blf"))):
        rows = Rows.concatenate(*read(other).pieces)
        columns = {"t": rows.t + start, "v": 3.6 * rows.speed, "P": rows.power / 1e3, "h": rows.context[Role.ALTITUDE]}
        written_table(columns, tmp_path / "tables" / "truck" / name)
        start += 86_400.0
    (tmp_path / "tables" / "truck" / "notes.md").write_text("no table")
    answer = ask("fleet", tmp_path / "tables", "-o", tmp_path / "out", *MAP, "--map", "altitude=h [m]")
    assert (answer["drives"], answer["rows"], answer["vehicles_estimated"]) == (2, {"estimated": 2}, 1)
    drives = pq.read_table(tmp_path / "out" / "drives.parquet").to_pydict()
    assert drives["mass_kg_mean"] == pytest.approx([TRUCK.mass] * 2, rel=0.02)


def test_files_may_have_other_names_and_units_of_a_column(tmp_path: Path) -> None:
    """Two loggers, of one fleet: the same values come of both, also of a force, a temperature and times."""
    n = 300
    one = {"t": np.arange(n) / 10, "v": np.full(n, 72.0), "F": np.full(n, 2.0), "T": np.full(n, 20.0)}
    other = {"Zeit": 100.0 * np.arange(n), "v_m": np.full(n, 20.0), "F_N": np.full(n, 2e3), "T_F": np.full(n, 68.0)}
    mappings = ["time=t [s]", "time=Zeit [ms]", "speed=v [km/h]", "speed=v_m [m/s]", "force=F [kN]", "force=F_N [N]"]
    mappings += ["ambient_temperature=T [degC]", "ambient_temperature=T_F [degF]"]
    config = configuration.replace(Config(), table=table_of(None, mappings))
    files = [written_table(columns, tmp_path / f"{i}.csv") for i, columns in enumerate((one, other))]
    rows, others = (read(file, config).pieces[0] for file in files)
    for of in (rows, others):
        assert (of.speed[50], of.power[50]) == pytest.approx((20.0, 4e4))
        assert of.context[Role.AMBIENT_TEMPERATURE][50] == pytest.approx(293.15)
        assert of.t[-1] - of.t[0] == pytest.approx(n / 10, abs=0.3)


def test_columns_of_the_command_come_before_those_of_the_configuration() -> None:
    given = Table(columns={"speed": "v [km/h]"}, alternatives={"speed": ["w [m/s]"], "power": ["P [W]"]})
    assert table_of(given, []) == given
    assert table_of(given, ["speed=x [km/h]"]).alternatives == {"power": ["P [W]"]}
    with pytest.raises(ConfigError, match=r"table\.alternatives\.power: goes with a column in table\.columns"):
        columns_of(given)


@pytest.mark.usefixtures("without_workers")
def test_a_fleet_of_tables_counts_the_logs_of_frames_beside_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And not what an earlier run has left in its folder."""
    pytest.importorskip("pyarrow", reason="the extra `fleet` is not installed")
    written_table(steady(), tmp_path / "van" / "a.csv")
    for other in ("truck/drive.blf", "truck/drive.asc", "van/notes.md", "out/exports/earlier.log"):
        (tmp_path / other).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / other).write_text("anything")
    assert main(["fleet", str(tmp_path), "-o", str(tmp_path / "out"), *MAP, "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["left_out"] == 2
    (said,) = [line for line in err.splitlines() if "left out" in line]
    assert said == (
        f"note: logs of frames left out, 2 files: {tmp_path}/truck/drive.asc, {tmp_path}/truck/drive.blf; "
        "read them without --map and [table], in a run of their own"
    )


@pytest.mark.usefixtures("without_workers")
def test_the_tables_of_a_fleet_are_no_logs_of_the_next_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pyarrow", reason="the extra `fleet` is not installed")
    written_table(steady(), tmp_path / "van" / "a.csv")
    for name in ("out", "out", "other"):
        assert main(["fleet", str(tmp_path), "-o", str(tmp_path / name), *MAP, "--json"]) == 0
        out, err = capsys.readouterr()
        assert json.loads(out)["rows"] == {"unestimated": 1}
        assert "drives." not in err
    assert main(["fleet", str(tmp_path / "out"), "-o", str(tmp_path / "out"), *MAP]) == 2
    assert "no logs there but tables of an earlier run; give the logs as SOURCE" in capsys.readouterr().err
    own = tmp_path / "own"
    written_table(steady(), own / "drives.csv")
    assert main(["fleet", str(own), "-o", str(own), *MAP]) == 2
    assert "has logs with the names of tables of a fleet; give another folder" in capsys.readouterr().err


@pytest.mark.usefixtures("without_workers")
def test_a_fleet_of_tables_without_a_column_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A line for each file, and one for all of them."""
    pytest.importorskip("pyarrow", reason="the extra `fleet` is not installed")
    written_table(steady(), tmp_path / "truck" / "a.csv")
    arguments = ["fleet", str(tmp_path), "-o", str(tmp_path / "out"), *MAP[:2], "--map", "power=W [kW]"]
    assert main(arguments) == 2
    unreadable, nothing = capsys.readouterr().err.splitlines()
    assert "a.csv: has no column 'W'; there are 't', 'v', 'P'" in unreadable
    assert "none of 1 log can be used" in nothing


EPOCH = 1_767_600_000  # s, of a day in 2026


@pytest.mark.parametrize(
    ("start", "step", "said"),
    [
        (0, 100, 'has a row every 100 s; {}; if its times are milliseconds, say so: --map time="t [milliseconds]"'),
        (EPOCH * 10**3, 100, 'a row every 100 s; {}; if its times are milliseconds, say so: --map time="t [millisec'),
        (EPOCH * 10**3, 1, 'has times up to 1.77e+12 s; {}; if its times are milliseconds, say so: --map time="t [mi'),
        (EPOCH * 10**6, 10**5, 'a row every 1e+05 s; {}; if its times are microseconds, say so: --map time="t [micro'),
        (EPOCH * 10**6, 10**3, 'a row every 1e+03 s; {}; if its times are microseconds, say so: --map time="t [micro'),
        (EPOCH * 10**9, 10**8, 'a row every 1e+08 s; {}; if its times are nanoseconds, say so: --map time="t [nano'),
    ],
)
def test_times_in_a_finer_unit_get_the_line_that_reads_them(
    start: int, step: int, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = written_table(steady(t=[start + step * i for i in range(200)]), tmp_path / "a.csv")
    line = refused(capsys, "inspect", file, *MAP[:4])
    reason = "the mass follows from changes of speed within a second or two, so give rows of 2 s or less"
    assert said.format(reason) in line
    (time,) = re.findall(r'--map (time="[^"]*")', line)
    assert main(["inspect", str(file), *MAP[:4], "--map", time.replace('"', "")]) == 0


@pytest.mark.parametrize(("step", "is_offered"), [(2.5, False), (5, False), (8, False), (10, True), (2000, True)])
def test_a_finer_unit_is_offered_where_it_gives_steps_of_a_table(
    step: float, is_offered: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = written_table(steady(t=[step * i for i in range(200)]), tmp_path / "a.csv")
    line = refused(capsys, "estimate", file, *MAP[:4])
    assert f"has a row every {step:.3g} s; the mass follows from changes of speed" in line
    assert ("if its times are" in line) == is_offered
    assert is_offered or line.endswith("so give rows of 2 s or less")


def test_one_of_several_columns_of_times_has_to_be_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = written_table({"seconds": [i // 10 for i in range(200)], **steady()}, tmp_path / "a.csv")
    line = refused(capsys, "inspect", file, *MAP[:4])
    assert "'seconds' and 't' may each be the times; name one of them: --map time=\"COLUMN [s]\"" in line
    assert main(["inspect", str(file), *MAP]) == 0


@pytest.mark.parametrize("is_number", [False, True])
def test_columns_of_dates_and_times_of_day_are_joined(
    is_number: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Over midnight; a number beside the date may be seconds, or hours, minutes and seconds in one."""
    start = np.datetime64("2026-05-04T23:59:50")
    whole = [str(start + np.timedelta64(100 * i, "ms")).split("T") for i in range(200)]
    columns = {key: cells for key, cells in steady().items() if key != "t"}
    times = [i / 10 if is_number else time for i, (_, time) in enumerate(whole)]
    columns = {"Time": times, "Date": [date for date, _ in whole], **columns}
    file = written_table(columns, tmp_path / "a.csv")
    if is_number:
        assert "'Date' and 'Time' may each be the times; name" in refused(capsys, "inspect", file, *MAP[:4])
    else:
        (rows,) = read(file, columns=RATES).pieces
        assert rows.t[0] == pytest.approx(start.astype(float), abs=2 * STEP)
        assert rows.t[-1] - rows.t[0] == pytest.approx(19.9, abs=2 * STEP)


def test_time_differences_are_times_and_truth_values_with_gaps_are_states(tmp_path: Path) -> None:
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    brake = [None if i % 2 else i >= 100 for i in range(200)]
    columns = steady(brake=brake, t=np.arange(200) * np.timedelta64(100, "ms"))
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    written_table({**columns, "t": steady()["t"]}, tmp_path / "a.csv")
    for file in (tmp_path / "a.parquet", tmp_path / "a.csv"):
        (rows,) = read(file, columns={**RATES, "brake_switch": "brake"}).pieces
        assert rows.t[-1] - rows.t[0] == pytest.approx(19.9, abs=2 * STEP)
        assert rows.context[Role.BRAKE_SWITCH][[20, 180]].tolist() == [0.0, 1.0]
    with pytest.raises(LogError, match="row 1, column 'brake': 'False' is no number"):
        read(tmp_path / "a.csv", columns={"speed": "brake [km/h]", "power": "P [kW]"})


def test_on_and_off_are_states_in_any_case(tmp_path: Path) -> None:
    words = ["off", "OFF", "Off", ""] * 25 + ["on", "ON", " On ", ""] * 25
    file = written_table(steady(brake=words, word=words), tmp_path / "a.csv")
    (rows,) = read(file, columns={**RATES, "brake_switch": "brake"}).pieces
    assert rows.context[Role.BRAKE_SWITCH][[20, 180]].tolist() == [0.0, 1.0]
    with pytest.raises(LogError, match="row 1, column 'word': 'off' is no number; correct it"):
        read(file, columns={**RATES, "altitude": "word [m]"})


RATES = {"speed": "v [km/h]", "power": "P [kW]"}


def of_two_rates(n: int, every: int = 2) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """One table with the power in every second row, and the same one with a row for each value, at the same times."""
    t, v = np.arange(n) / 10, 60.0 + 10.0 * np.sin(np.arange(n) / 40)
    joined = {"t": t, "v": v, "P": np.where(np.arange(n) % every, np.nan, 50.0)}
    at = np.sort(np.concatenate([np.arange(n), np.arange(0, n, every)]))
    is_power = np.diff(at, prepend=-1) == 0
    apart = {"t": t[at], "v": np.where(is_power, np.nan, v[at]), "P": np.where(is_power, 50.0, np.nan)}
    return joined, apart


@pytest.mark.parametrize("every", [1, 2])
def test_rows_of_one_time_that_fill_other_columns_are_one_row(every: int) -> None:
    """As in an export of channels of several rates: 10 Hz of speed and 5 or 10 Hz of power, in pieces of the table."""
    joined, apart = of_two_rates(11_000, every)
    (expected,), (rows,) = (from_table(columns, **RATES).pieces for columns in (joined, apart))
    np.testing.assert_array_equal(rows.t, expected.t)
    np.testing.assert_array_equal(rows.speed, expected.speed)
    np.testing.assert_array_equal(rows.power, expected.power)


def test_a_force_is_multiplied_by_the_speed_of_another_row_of_its_time() -> None:
    _, apart = of_two_rates(300)
    (rows,) = from_table(apart, speed="v [km/h]", force="P [kN]").pieces
    assert rows.power[50] == pytest.approx(5e4 * rows.speed[50], rel=1e-3)


def test_a_value_at_the_time_of_another_one_is_refused_and_its_row_counted(tmp_path: Path) -> None:
    """Row 4 repeats a speed, brings the power of its time, and is counted; row 3 has no value."""
    t = [0.0, 0.1, 0.1, 0.1, 0.2, 0.3]
    v, P = [70.0, 71.0, np.nan, 99.0, 72.0, 73.0], [50.0, np.nan, np.nan, 51.0, 52.0, 53.0]
    log = TableLog(written_table({"t": t, "v": v, "P": P}, tmp_path / "a.csv"), Table(columns=RATES))
    (frames,) = log
    assert frames.t.tolist() == [0.0, 0.0, 0.1, 0.1, 0.2, 0.2, 0.3, 0.3]
    assert frames.data.view(np.float64)[:, 0].tolist() == [70.0, 50.0, 71.0, 51.0, 72.0, 52.0, 73.0, 53.0]
    assert log.skipped == {SAME_TIME: 1}


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 2), st.booleans(), st.booleans()), max_size=30), st.integers(1, 30))
def test_rows_of_one_time_are_joined_however_they_are_cut_into_pieces(
    rows: list[tuple[int, bool, bool]], size: int
) -> None:
    """Against a mapping of each time and column to its first value."""
    t = np.cumsum([0.0, *(step for step, _, _ in rows)])[1:]
    cells = np.array([[i if v else np.nan, -i if P else np.nan] for i, (_, v, P) in enumerate(rows)]).reshape(-1, 2)
    first, refused = dict[tuple[float, int], float](), set[int]()
    for i, j in zip(*np.nonzero(np.isfinite(cells)), strict=True):
        if (t[i], j) in first:
            refused.add(int(i))
        first.setdefault((t[i], j), cells[i, j])
    joiner = SameTimes(2)
    parts = [joiner.feed(t[i : i + size], cells[i : i + size]) for i in range(0, len(t), size)]
    times, joined = (np.concatenate(some) for some in zip(*parts, joiner.finish(), strict=True))
    assert times.tolist() == sorted(set(t.tolist()))
    there = zip(*np.nonzero(np.isfinite(joined)), strict=True)
    assert {(times[i], j): joined[i, j] for i, j in there} == first
    assert (joiner.times, joiner.refused) == (len(times), len(refused))
    assert joiner.first == min(refused, default=-1) + 1


@pytest.mark.parametrize("text", ["Dyno_Speed[mph]", " Dyno_Speed[mph]", "Dyno_Speed[mph] [mph]", "v [km/h]"])
@pytest.mark.parametrize("time", ["Time[sec]", "Time[sec] [s]", "t [ms]"])
def test_a_unit_in_the_heading_of_a_column_is_its_unit(text: str, time: str, tmp_path: Path) -> None:
    """The whole text is a column, or what stands before its last brackets; in memory and in a file."""
    n = 200
    columns = {"Time[sec]": np.arange(n) / 10, "t": 100.0 * np.arange(n), "Dyno_Speed[mph]": np.full(n, 45.0)}
    columns |= {"v": np.full(n, 45 * 1.609344), "P[kW]": np.full(n, 50.0), "Brake[on]": np.zeros(n)}
    roles = {"time": time, "speed": text, "power": "P[kW]", "brake_switch": "Brake[on]"}
    (in_memory,) = from_table(columns, **roles).pieces
    (in_file,) = read(written_table(columns, tmp_path / "a.csv"), columns=roles).pieces
    for rows in (in_memory, in_file):
        assert rows.speed[50] == pytest.approx(45 * 0.44704)
        assert rows.power[50] == pytest.approx(5e4)
        assert len(rows) == pytest.approx(n, abs=3)


def test_a_unit_in_round_brackets_of_a_heading_is_its_unit(tmp_path: Path) -> None:
    """Where it is a unit; other words in them are a part of the name."""
    n = 200
    columns = {"Time (ms)": 100.0 * np.arange(n), "Vehicle Speed (mph)": np.full(n, 45.0)}
    columns |= {"Power (kW)": np.full(n, 50.0), "Brake (foot)": np.zeros(n)}
    roles = {"time": "Time (ms)", "speed": "Vehicle Speed (mph)", "power": "Power (kW)", "brake_switch": "Brake (foot)"}
    (rows,) = read(written_table(columns, tmp_path / "a.csv"), columns=roles).pieces
    assert (rows.speed[50], rows.power[50]) == pytest.approx((45 * 0.44704, 5e4))
    assert len(rows) == pytest.approx(n, abs=3)
    assert split_unit("Speed (front)") == ("Speed (front)", None)


@pytest.mark.parametrize(
    ("role", "said"),
    [
        (
            ["speed=v[km/h] [mph]"],
            """column 'v[km/h]' is in 'km/h' by the file, and 'v[km/h] [mph]' takes it in 'mph'""",
        ),
        (
            ["force=F[kN] [N]"],
            """column 'F[kN]' is in 'kN' by the file, and 'F[kN] [N]' takes it in 'N'; write "F[kN]\"""",
        ),
        (
            ["time=t[ms] [s]"],
            """column 't[ms]' is in 'ms' by the file, and 't[ms] [s]' takes it in 's'; write "t[ms]\"""",
        ),
        (
            ["speed=v (mph) [km/h]"],
            """column 'v (mph)' is in 'mph' by the file, and 'v (mph) [km/h]' takes it in 'km/h'; write "v (mph)\"""",
        ),
        (["speed=v (1) [km/h]"], ""),
        (["time=t[ms] [ms]"], ""),
        (["brake_switch=on[%] [1]"], ""),
    ],
)
def test_a_unit_beside_another_one_in_the_heading_is_refused(
    role: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = {"t[ms]": 100 * np.arange(200), "v[km/h]": np.full(200, 72.0), "F[kN]": np.full(200, 2.0)}
    columns |= {"v (mph)": np.full(200, 45.0), "v (1)": np.full(200, 72.0), "on[%]": np.zeros(200)}
    file = written_table(columns, tmp_path / "a.csv")
    roles = {part.split("=")[0]: part for part in ["time=t[ms]", "speed=v[km/h]", "force=F[kN]", *role]}
    maps = [part for text in roles.values() for part in ("--map", text)]
    if said:
        assert said in refused(capsys, "inspect", file, *maps)
    else:
        assert main(["inspect", str(file), *maps]) == 0


@pytest.mark.parametrize(("unit", "seconds"), [("s", 1.0), ("Seconds", 1.0), ("msec", None), ("µs", 1e-6), ("", None)])
def test_units_of_time(unit: str, seconds: float | None) -> None:
    assert seconds_in(unit) == seconds


@pytest.mark.parametrize("suffix", [suffix for suffix in SUFFIXES if suffix not in {".csv.gz", ".mf4"}] + [".xlsx"])
def test_a_table_that_is_given_as_a_log_leads_to_map(
    suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An unknown suffix may be one of a log too, and so may .txt."""
    (tmp_path / f"a{suffix}").write_bytes(b"t;v;P\n0;72;50\n")
    line = refused(capsys, "estimate", tmp_path / f"a{suffix}")
    assert line.endswith('fleet: --map speed="COLUMN [km/h]" --map power="COLUMN [kW]"')
    assert ("unknown log format" in line) == (suffix in {".txt", ".xlsx"})


def test_a_file_that_is_no_table_is_refused_with_the_formats_that_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.xlsx").write_bytes(b"PK")
    line = refused(capsys, "estimate", tmp_path / "a.xlsx", *MAP)
    assert "a.xlsx: is no table that can be read (.csv, " in line
    assert line.endswith("); export it as one of them, or, for a log, take out --map, or [table] of the configuration")


def test_rows_that_come_too_seldom_are_refused_before_all_are_read(tmp_path: Path) -> None:
    """Days of such rows would be processed in vain."""
    (tmp_path / "slow.csv").write_text("t,v,P\n" + "".join(f"{5 * i},50,9\n" for i in range(100_000)))
    log = TableLog(tmp_path / "slow.csv", Table(columns={"speed": "v [km/h]", "power": "P [kW]"}))
    with pytest.raises(LogError, match="has a row every 5 s; the mass follows from changes of speed within"):
        list(log)
    assert log.progress < 0.5
