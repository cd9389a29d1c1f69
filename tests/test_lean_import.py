"""Imports without a package that python-can would import as well."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from estimator.lean_import import import_lean

USER = """
try:
    import rl_wanted
except ImportError:
    rl_wanted = None
"""


@pytest.fixture
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A module `rl_user` that imports `rl_wanted` if that is installed, and one that cannot be imported."""
    (tmp_path / "rl_wanted.py").write_text("")
    (tmp_path / "rl_user.py").write_text(USER)
    (tmp_path / "rl_broken.py").write_text("import rl_nowhere\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("rl_wanted", "rl_user"):
        monkeypatch.delitem(sys.modules, name, raising=False)


@pytest.mark.usefixtures("modules")
def test_the_package_is_missing_for_that_module_alone():
    assert import_lean("rl_user", without=["rl_wanted"]).rl_wanted is None
    assert importlib.import_module("rl_wanted").__name__ == "rl_wanted"


@pytest.mark.usefixtures("modules")
def test_what_was_imported_before_stays():
    wanted = importlib.import_module("rl_wanted")
    assert import_lean("rl_user", without=["rl_wanted"]).rl_wanted is wanted


@pytest.mark.usefixtures("modules")
def test_a_module_that_cannot_be_imported_leaves_nothing_behind():
    with pytest.raises(ImportError, match="rl_nowhere"):
        import_lean("rl_broken", without=["rl_wanted"])
    assert "rl_wanted" not in sys.modules


@pytest.mark.usefixtures("modules")
def test_contents_of_a_deferred_package_are_imported_when_they_are_used(tmp_path):
    (tmp_path / "rl_wanted.py").write_text("class Table:\n    rows = 3\n\ndef half(x, by=2):\n    return x / by\n")
    (tmp_path / "rl_taker.py").write_text("from rl_wanted import Table, half\n")
    taker = import_lean("rl_taker", deferring=["rl_wanted"])
    assert "rl_wanted" not in sys.modules
    assert taker.Table.rows == 3
    assert taker.half(6, by=4) == 1.5
    assert sys.modules["rl_wanted"].half is not taker.half
    assert import_lean("rl_user", deferring=["rl_wanted"]).rl_wanted is sys.modules["rl_wanted"]


@pytest.mark.usefixtures("modules")
def test_a_deferred_package_that_is_used_at_once_is_imported_at_once(tmp_path):
    (tmp_path / "rl_wanted.py").write_text("def half(x):\n    return x / 2\n")
    (tmp_path / "rl_hasty.py").write_text("from rl_wanted import half\nquarter = half(0.5)\n")
    assert import_lean("rl_hasty", deferring=["rl_wanted"]).quarter == 0.25
    assert sys.modules["rl_wanted"].half(6) == 3


@pytest.mark.slow
def test_a_kalman_filter_imported_without_its_statistics_has_them_when_they_are_asked_for():
    program = (
        "import sys; from estimator.lean_import import import_lean;"
        "import_lean('filterpy.kalman', deferring=['filterpy.stats']).KalmanFilter(2, 1).predict();"
        "print('scipy.stats' in sys.modules);"
        "from filterpy.stats import logpdf; print(round(logpdf(0.0, 0.0, 1.0), 3), 'scipy.stats' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "-0.919", "True"]


@pytest.mark.slow
def test_a_command_on_logs_imports_no_library_of_tables():
    program = (
        "import sys; from estimator.commands.main import main; main(['inspect', 'none.blf']);"
        "print(*{'can', 'asammdf', 'pandas'} & sys.modules.keys())"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["can"]


@pytest.mark.slow
def test_a_command_imports_neither_compilers_nor_tables_and_leaves_them_to_others():
    program = (
        "import sys; from estimator.commands.main import main; main(['estimate', 'nowhere.asc']);"
        "print([name for name in ('asammdf', 'numpy.f2py.rules', 'scipy.stats', 'matplotlib', 'distributed', 'pandas')"
        " if name in sys.modules]); import numpy; print(numpy.f2py.f2py2e.__name__)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["[]", "numpy.f2py.f2py2e"]
