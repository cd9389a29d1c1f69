"""Every check has a record of the present version, and every page shows what the records hold."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import results_pages
from harness.check import RESULTS
from project_paths import ROOT
from results_pages import EXCEPTIONS, checks, records

from estimator import __version__
from estimator.errors import InputError

pytestmark = pytest.mark.slow  # the checks are imported
Patch = pytest.MonkeyPatch


@pytest.fixture
def copies(tmp_path: Path, monkeypatch: Patch) -> Path:
    """The records and pages in a folder of their own."""
    for name in ("results", "docs"):
        shutil.copytree(ROOT / name, tmp_path / name)
    shutil.copy(ROOT / "README.md", tmp_path)
    for name, path in (("ROOT", "."), ("RESULTS", "results"), ("DOCS", "docs")):
        monkeypatch.setattr(results_pages, name, tmp_path / path)
    return tmp_path


def change(path: Path, **changes: Any) -> None:
    record = json.loads(path.read_bytes()) | changes
    path.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n")


def test_every_page_shows_what_its_records_hold() -> None:
    assert [path.name for path in results_pages.stale()] == []  # else: python tools/results_pages.py


def test_no_figure_is_older_than_the_program() -> None:
    older = {name for name, record in records().items() if record["version"] != __version__}
    missing = set(checks()) - {record["check"] for record in records().values()}
    assert older | missing == set(EXCEPTIONS)


def test_a_record_is_named_after_its_check() -> None:
    for name, record in records().items():
        assert f"{name}_".startswith(f"{record['check']}_")
        assert str(ROOT) not in (RESULTS / f"{name}.json").read_text()


def test_a_command_gives_the_options_of_its_record() -> None:
    for name, record in records().items():
        check = checks()[record["check"]]
        _, program, *arguments = check.command(record["options"]).split()
        assert (ROOT / program).is_file()
        first = check.first.split()
        options = check.parser().parse_args(arguments[len(first) - 1 if first[1:] else 0 :])
        assert {key: vars(options)[key] for key in record["options"]} == record["options"], name


def test_a_changed_figure_is_noticed_on_its_page_and_where_it_is_quoted(copies: Path) -> None:
    path = copies / "results" / "fleet.json"
    figures = json.loads(path.read_bytes())["figures"]
    figures["compared"]["C"]["holds"] -= 1
    change(path, figures=figures)
    (copies / "results" / "gone.md").write_text("# Gone\n")
    found = {path.relative_to(copies).as_posix(): text for path, text in results_pages.stale().items()}
    assert {"results/fleet.md", "results/gone.md", "docs/accuracy.md"} <= set(found)
    assert found["results/gone.md"] == ""
    assert "results/attacks.md" not in found


def test_a_page_that_quotes_a_record_that_is_missing_is_refused(copies: Path) -> None:
    (copies / "results" / "weighing.json").unlink()
    with pytest.raises(InputError, match=r"weighing\.json: No such file"):
        results_pages.stale()


def test_pages_are_written(copies: Path, monkeypatch: Patch) -> None:
    change(copies / "results" / "fleet.json", version="0.0.1")
    (copies / "results" / "fleet.md").unlink()
    monkeypatch.setattr("sys.argv", ["results_pages.py", "--check"])
    assert results_pages.main() == 1
    monkeypatch.setattr("sys.argv", ["results_pages.py"])
    assert results_pages.main() == 0
    assert results_pages.stale() == {}
    assert "Version 0.0.1." in (copies / "results" / "fleet.md").read_text()
    assert {path.stem for path in (copies / "results").glob("*.md")} == set(records())
