"""A check's figures are written whole and the same each time, and its tables are made of them alone."""

import ast
import json
from argparse import ArgumentParser, Namespace
from pathlib import Path

import numpy as np
import pytest
from harness.check import Cells, Check, Figures, Table, cell
from harness.scores import Score, bootstrap, share, summary
from project_paths import TESTS

from estimator import __version__
from estimator.errors import InputError

Captured = pytest.CaptureFixture[str]


def options(parser: ArgumentParser) -> None:
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path)


def measure(chosen: Namespace) -> Figures:
    if chosen.seed < 0:
        raise InputError(f"--seed: {chosen.seed} is negative; give one from 0 on")
    draws = np.random.default_rng(chosen.seed).normal(size=3)
    return {"rows": [{"name": "a|b", "mean": draws.mean(), "interval": draws, "none": np.nan}], "count": np.int64(3)}


def tables(figures: Figures) -> list[Table]:
    return [Table.of("Draws", figures["rows"])]


CHECK = Check(
    title="Draws",
    measure=measure,
    tables=tables,
    headline=Cells(rows=("a",), columns=("mean",)),
    options=options,
    fails=lambda x: x["count"] > 3,
)


def test_the_same_options_write_the_same_bytes(tmp_path: Path, capsys: Captured) -> None:
    paths = [tmp_path / "new" / name for name in ("one.json", "two.json")]
    for path in paths:
        assert CHECK.main(["--seed", "4", "--folder", str(tmp_path), "--out", str(path), "--json"]) == 0
    assert paths[0].read_bytes() == paths[1].read_bytes()
    record = json.loads(paths[0].read_bytes())
    assert {key: record[key] for key in ("check", "version", "options")} == {
        "check": "test_harness",
        "version": __version__,
        "options": {"seed": 4},  # and no path of this machine
    }
    assert record["figures"]["rows"][0]["none"] is None
    assert capsys.readouterr().out == 2 * paths[0].read_text()


def test_tables_are_made_of_what_was_written(tmp_path: Path, capsys: Captured) -> None:
    path = tmp_path / "draws.json"
    assert CHECK.main(["--seed", "4", "--out", str(path)]) == 0
    page = capsys.readouterr().out
    assert CHECK.main(["--read", str(path)]) == 0
    assert capsys.readouterr().out == page
    assert page.startswith("## Draws\n\n| name | mean | interval | none |\n| --- | --- | --- | --- |\n| a/b | ")
    record = json.loads(path.read_bytes())
    record["figures"]["count"] = 4
    path.write_text(json.dumps(record))
    assert CHECK.main(["--read", str(path)]) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--seed", "-1"], "--seed: -1"), (["--read", "none.json"], "none.json"), (["--read", "half.json"], "half.json")],
)
def test_what_cannot_be_used_is_one_line(
    arguments: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("half.json").write_text('{"figures": ')
    assert CHECK.main([*arguments, "--out", "x.json"]) == 2
    complaint = capsys.readouterr().err
    assert (complaint.count("\n"), complaint[:7]) == (1, "error: ")
    assert words in complaint
    assert not Path("x.json").exists()


def test_numbers_are_shown_with_what_is_known_of_them() -> None:
    assert [cell(x) for x in (0.16412, 27190.4, "text", None, 3)] == ["0.1641", "27,190", "text", "-", "3"]
    assert cell([1.5, 0.25]) == "1.5 +- 0.25"
    assert cell([1.5, 1.0, 2.0]) == "1.5 (1 .. 2)"


def test_errors_are_summed_up_and_counted() -> None:
    scores = [Score(error, 0.01, holds, 0.02) for error, holds in ((0.01, True), (-0.03, False), (0.02, True))]
    found = summary(scores, (0.015,))
    assert (found["estimated"], found["within_1.5_percent"], found["holds"]) == (3, 1, 2)
    assert (found["median"], found["worst"]) == (0.02, 0.03)
    assert found["bias"] == pytest.approx(0.0)
    assert found["rms"] == pytest.approx(np.sqrt(14e-4 / 3))
    assert summary([], (0.015,)) == {"estimated": 0, "within_1.5_percent": 0, "holds": 0}


def test_intervals_of_shares_and_medians() -> None:
    half = share(5, 10)
    assert (half.value, half.n) == (0.5, 10)
    assert (half.low, half.high) == pytest.approx((0.2366, 0.7634), abs=1e-4)  # Wilson
    assert np.isnan(share(0, 0).value)
    sample = np.random.default_rng(1).normal(2.0, 1.0, 400)
    found = bootstrap(lambda x: float(np.mean(x)), sample)
    assert found.high - found.low == pytest.approx(2 * 1.96 * sample.std() / 20, rel=0.1)


def test_the_command_of_a_record_gives_its_options() -> None:
    assert CHECK.command({"seed": 1}) == "python tests/tools/test_harness.py"
    assert CHECK.command({"seed": 4}) == "python tests/tools/test_harness.py --seed 4"


def test_the_most_important_cells_have_the_names_of_their_rows_and_columns() -> None:
    made = [Table("", ("", "mean", "sd"), [["a", "1", "2"], ["ab", "3", "4"], ["b", "5", "6"]]), Table("x", (), [])]
    assert CHECK.headline.text(made) == "**a**: mean 1; **ab**: mean 3"
    assert Cells().text(made) == "**a**: mean 1, sd 2; **ab**: mean 3, sd 4; **b**: mean 5, sd 6"
    assert Cells().text([Table("", ("", "value"), [["a", "1"]])]) == "**a**: 1"
    assert Cells(rows=()).text(made) == Cells(table="x").text(made) == Cells(table="none").text(made) == ""


@pytest.mark.slow
def test_no_test_module_imports_another() -> None:
    """What several of them need is in tests/support."""
    imported = set()
    for path in TESTS.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                imported.add((path.name, node.module or ""))
            elif isinstance(node, ast.Import):
                imported |= {(path.name, alias.name) for alias in node.names}
    assert {pair for pair in imported if pair[1].startswith("test_")} == set()
