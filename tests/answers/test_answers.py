"""Every command prints what the types of `estimator.answers` say, no key more or less; and the schemas are theirs."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from daemon_bench import Bench
from hypothesis import given
from hypothesis import strategies as st
from simulated_logs import ask, drive, written

from estimator.answers.answer import Answer, as_text, decode, encode
from estimator.answers.fleet import FleetAnswer
from estimator.answers.status import StatusAnswer
from estimator.commands.main import main


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(drive("urban", 2, 1), tmp_path_factory.mktemp("answers") / "drive.blf")


@pytest.mark.slow
@pytest.mark.parametrize("command", ["estimate", "replay", "inspect", "check", "diagnose"])
def test_a_command_that_reads_a_log_prints_its_type(log: Path, command: str) -> None:
    assert next(iter(ask(command, log))) == "schema"


def test_simulate_prints_its_type(tmp_path: Path) -> None:
    answer = ask("simulate", tmp_path / "x.log", "--minutes", 1, "--effect", "brake_use@10-20")
    assert answer["effects"][0]["active_s"] == [[10.0, 20.0]]


@pytest.mark.slow
def test_fleet_prints_its_type(log: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="the extra `fleet` is not installed")
    assert ask("fleet", log, "-o", tmp_path / "fleet", "--workers", 1)["drives"] == 1


@pytest.mark.nightly
@pytest.mark.slow
def test_fleet_says_why_a_vehicle_is_not_estimated(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pyarrow", reason="the extra `fleet` is not installed")
    assert main(["fleet", str(log), "-o", str(tmp_path / "fleet"), "--workers", "1"]) == 0
    assert "1 drive, A/m and C unestimated (no drive with an estimated mass)" in capsys.readouterr().out


def test_status_adds_whether_a_daemon_runs(tmp_path: Path) -> None:
    Bench(tmp_path).turn()
    told = json.loads((tmp_path / "status.json").read_text())
    assert list(told)[:2] == ["schema", "version"]
    status = decode(json.dumps(told), StatusAnswer)
    assert json.loads(encode(status)) == told
    shown = json.loads(as_text(msgspec.structs.replace(status, running=True, why_not="")))
    assert list(shown)[:4] == ["schema", "running", "why_not", "version"]


class Small(Answer, frozen=True, kw_only=True):
    x: float | None


@pytest.mark.parametrize(
    ("value", "shown"), [(1e-5, "1e-05"), (np.nan, "null"), (-np.inf, "null"), (np.float64(0.1), "0.1")]
)
def test_numbers_are_printed_in_full_or_are_null(value: float, shown: str) -> None:
    assert as_text(Small(x=value)) == f'{{\n  "schema": 1,\n  "x": {shown}\n}}'


def test_a_name_of_a_file_that_is_no_text_is_escaped() -> None:
    answer = FleetAnswer(
        drives=1, rows={"a\udcff": 1}, vehicles=1, vehicles_estimated=0, outliers={}, files=("\udcff",)
    )
    told = json.loads(as_text(answer))
    assert told["files"] == ["\\udcff"]
    assert told["rows"] == {"a\\udcff": 1}


def test_an_answer_of_another_schema_is_refused() -> None:
    with pytest.raises(msgspec.ValidationError, match="answer of schema 2; schema 1 is read here"):
        decode(b'{"schema":2,"x":1.0}', Small)


def test_an_answer_without_a_schema_is_refused() -> None:
    with pytest.raises(msgspec.ValidationError, match="missing required field `schema`"):
        decode(b'{"x":1.0}', Small)


@pytest.mark.slow
@given(st.none() | st.floats(allow_nan=False, allow_infinity=False))
def test_an_answer_decodes_as_it_was_encoded(x: float | None) -> None:
    assert encode(Small(x=x)).startswith(b'{"schema":1,')
    assert decode(encode(Small(x=x)), Small) == Small(x=x)


def test_schemas_in_the_documents_are_those_of_the_types() -> None:
    from json_schemas import FOLDER, schemas

    assert {path: path.read_text() for path in FOLDER.iterdir()} == schemas(), "run tools/json_schemas.py"
